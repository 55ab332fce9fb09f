"""Every kind of object is drawn and read back from the file."""

from __future__ import annotations

import numpy as np
import pytest
import rerun as rr

from physx_core.components import Event, Factory
from physx_core.components.scene.kinds import KINDS
from physx_core.errors import VisualizerError

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
CELLS = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.fixture
def scene(opened, read):
    """Return a factory, a function that shows what it made at a step, and one that reads back."""
    visualizer, factory = opened(), Factory()

    def show(step):
        visualizer.events(1, step, factory.take_events())

    def saved(entity, component):
        visualizer.close()
        path = f"/env_1/{entity}" if entity[:3] != "../" else entity[2:]
        return read(visualizer.file, path, component)

    return factory, show, saved


def test_mesh(scene):
    factory, show, saved = scene
    factory.add_mesh("plate", SQUARE, CELLS, color="#ff0000", alpha=0.5)
    show(0)
    factory.update_mesh("plate", positions=SQUARE + 1)
    show(3)
    assert saved("plate", "Mesh3D:triangle_indices") == [(0, CELLS.tolist())]
    positions = saved("plate", "Mesh3D:vertex_positions")
    assert positions == [(0, SQUARE.tolist()), (3, (SQUARE + 1).tolist())]
    assert saved("plate", "Mesh3D:vertex_normals")[0][1] == [[0, 0, 1]] * 4
    assert saved("plate", "Mesh3D:albedo_factor") == [(0, [0xFF000080])]


def test_mesh_with_a_scalar_field(scene):
    factory, show, saved = scene
    factory.add_mesh("plate", SQUARE, CELLS, scalar_field=[0, 1, 2, 3], colormap="gray")
    show(0)
    factory.update_mesh("plate", scalar_field=[3, 3, 3, 6])
    show(1)
    factory.update_mesh("plate", color="#0000ff")
    show(2)
    black, white, half = 0x000000FF, 0xFFFFFFFF, 0x808080FF
    (_, first), (_, second), (_, third) = saved("plate", "Mesh3D:vertex_colors")
    assert (first[0], first[3]) == (black, white)
    assert second == [half, half, half, white]
    assert third == []
    assert saved("plate", "Mesh3D:albedo_factor")[-1] == (2, [0x0000FFFF])


def test_mesh_as_wireframe_and_back(scene):
    factory, show, saved = scene
    factory.add_mesh("plate", SQUARE, CELLS, wireframe=True, color="#00ff00")
    show(0)
    factory.update_mesh("plate", wireframe=False)
    show(1)
    (_, edges), (_, none) = saved("plate/edges", "LineStrips3D:strips")
    assert len(edges) == 5
    assert none == []
    assert saved("plate/edges", "LineStrips3D:colors")[0] == (0, [0x00FF00FF])
    assert [len(v) for _, v in saved("plate", "Mesh3D:vertex_positions")] == [0, 4]


def test_a_mesh_of_few_triangles_shows_its_edges(scene):
    factory, show, saved = scene
    factory.add_mesh("plate", SQUARE, CELLS)
    show(0)
    ((_, edges),) = saved("plate/edges", "LineStrips3D:strips")
    assert len(edges) == 5
    assert [len(v) for _, v in saved("plate", "Mesh3D:vertex_positions")] == [4]


def test_points(scene):
    factory, show, saved = scene
    factory.add_points("cloud", SQUARE, color=(0, 1, 0), size=0.02)
    show(0)
    factory.update_points("cloud", positions=SQUARE[:2], scalar_field=[0, 1])
    show(1)
    assert [len(v) for _, v in saved("cloud", "Points3D:positions")] == [4, 2]
    assert saved("cloud", "Points3D:radii") == [(0, [pytest.approx(0.02)])]
    assert saved("cloud", "Points3D:colors") == [(0, [0x00FF00FF]), (1, [0x440154FF, 0xFDE725FF])]


def test_arrows(scene):
    factory, show, saved = scene
    factory.add_arrows("forces", SQUARE, SQUARE * 2, color="#112233")
    show(0)
    factory.update_arrows("forces", vectors=SQUARE * 3)
    show(1)
    assert saved("forces", "Arrows3D:origins") == [(0, SQUARE.tolist())]
    vectors = saved("forces", "Arrows3D:vectors")
    assert vectors == [(0, (SQUARE * 2).tolist()), (1, (SQUARE * 3).tolist())]


def test_lines(scene):
    factory, show, saved = scene
    factory.add_lines("path", SQUARE[:1])
    show(0)
    factory.update_lines("path", positions=SQUARE)
    show(1)
    strips = saved("path", "LineStrips3D:strips")
    assert strips == [(0, [SQUARE[:1].tolist()]), (1, [SQUARE.tolist()])]


def test_box_moves(scene):
    factory, show, saved = scene
    factory.add_box("crate", [1, 2, 3], color="#ffffff", position=[1, 0, 0])
    show(0)
    factory.update_box("crate", orientation=[0, 0, 1, 0])
    show(1)
    factory.update_box("crate", alpha=0.2, wireframe=True)
    show(2)
    assert saved("crate", "Boxes3D:half_sizes") == [(0, [[1, 2, 3]])]
    assert saved("crate", "Boxes3D:colors") == [(0, [0xFFFFFFFF]), (2, [0xFFFFFF33])]
    assert len(saved("crate", "Boxes3D:fill_mode")) == 2
    ((_, frame),) = saved("crate", "CoordinateFrame:frame")
    assert saved("tf", "Transform3D:translation") == [(0, [[1, 0, 0]]), (1, [[1, 0, 0]])]
    assert saved("tf", "Transform3D:quaternion") == [(0, [[0, 0, 0, 1]]), (1, [[0, 0, 1, 0]])]
    assert saved("tf", "Transform3D:child_frame") == [(0, frame), (1, frame)]


def test_sphere_and_capsule(scene):
    factory, show, saved = scene
    factory.add_sphere("ball", 0.5, position=[0, 0, 1])
    factory.add_capsule("pill", 0.25, 2.0)
    show(0)
    factory.update_sphere("ball", radius=1.0)
    factory.update_capsule("pill", length=4.0)
    show(1)
    assert saved("ball", "Ellipsoids3D:half_sizes") == [(0, [[0.5] * 3]), (1, [[1.0] * 3])]
    assert saved("pill", "Capsules3D:radii")[0] == (0, [0.25])
    assert saved("pill", "Capsules3D:lengths") == [(0, [2.0]), (1, [4.0])]
    # Rerun's capsule begins at the origin, the scene's is centered.
    translations = saved("pill", "Capsules3D:translations")
    assert translations == [(0, [[0, 0, -1]]), (1, [[0, 0, -2]])]


def test_changed_cells_and_half_sizes(scene):
    factory, show, saved = scene
    factory.add_mesh("plate", SQUARE, CELLS, wireframe=True, size=0.01)
    factory.add_box("crate", [1, 2, 3])
    show(0)
    factory.update_mesh("plate", positions=SQUARE[:3], cells=CELLS[:1], wireframe=False)
    factory.update_box("crate", half_sizes=[3, 2, 1])
    show(1)
    cells = saved("plate", "Mesh3D:triangle_indices")
    assert cells == [(0, []), (1, CELLS[:1].tolist())]
    assert saved("plate/edges", "LineStrips3D:radii")[0] == (0, [pytest.approx(0.01)])
    assert saved("crate", "Boxes3D:half_sizes") == [(0, [[1, 2, 3]]), (1, [[3, 2, 1]])]


def test_cylinder(scene):
    factory, show, saved = scene
    factory.add_cylinder("can", 0.25, 2.0, position=[1, 0, 0], label="soup", color="tomato")
    show(0)
    factory.update_cylinder("can", radius=0.5, position=[2, 0, 0])
    show(1)
    assert saved("can", "Cylinders3D:radii") == [(0, [0.25]), (1, [0.5])]
    assert saved("can", "Cylinders3D:lengths") == [(0, [2.0]), (1, [2.0])]
    assert saved("can", "Cylinders3D:labels") == [(0, ["soup"])]
    assert saved("can", "Cylinders3D:colors") == [(0, [0xFF6347FF])]
    assert saved("tf", "Transform3D:translation") == [(0, [[1, 0, 0]]), (1, [[2, 0, 0]])]


def test_several_lines_and_labels(scene):
    factory, show, saved = scene
    factory.add_lines("paths", [SQUARE, SQUARE[:2]], labels=["long", "short"])
    factory.add_points("cloud", SQUARE[:2], labels=["a", "b"])
    factory.add_arrows("forces", SQUARE[:1], SQUARE[1:2], labels=["1 N"])
    show(0)
    strips = [SQUARE.tolist(), SQUARE[:2].tolist()]
    assert saved("paths", "LineStrips3D:strips") == [(0, strips)]
    assert saved("paths", "LineStrips3D:labels") == [(0, ["long", "short"])]
    assert saved("cloud", "Points3D:labels") == [(0, ["a", "b"])]
    assert saved("forces", "Arrows3D:labels") == [(0, ["1 N"])]


def test_symbols(scene):
    factory, show, saved = scene
    look = {"symbol": "plus", "size": 0.5, "labels": ["here"], "color": "#ff0000"}
    factory.add_symbols("marks", [[1, 2, 3]], orientations=[[0, 2, 0]], **look)
    show(0)
    ((_, strips),) = saved("marks", "LineStrips3D:strips")
    corners = np.array(strips) - [1, 2, 3]
    assert corners.shape == (2, 2, 3)
    assert np.allclose(np.linalg.norm(corners, axis=2), 0.5)
    assert np.allclose(corners[:, :, 1], 0, atol=1e-6)
    assert saved("marks", "LineStrips3D:colors") == [(0, [0xFF0000FF])]
    assert saved("marks/labels", "Points3D:labels") == [(0, ["here"])]


def test_markers_move_with_their_mesh(scene):
    factory, show, saved = scene
    factory.add_mesh("plate", SQUARE, CELLS)
    factory.add_markers("marks", "plate", [1, 3], scalar_field=[0, 1], colormap="gray")
    show(0)
    factory.update_mesh("plate", positions=SQUARE + np.array([0, 0, 5]))
    show(1)
    (_, before), (_, after) = saved("marks", "LineStrips3D:strips")
    centers = [np.mean(strip[:-1], axis=0) for strip in (*before, *after)]
    expected = np.concatenate([SQUARE[[1, 3]], SQUARE[[1, 3]] + np.array([0, 0, 5])])
    assert np.allclose(centers, expected, atol=1e-6)
    assert saved("marks", "LineStrips3D:colors")[0] == (0, [0x000000FF, 0xFFFFFFFF])


def test_changed_looks_of_symbols(scene):
    factory, show, saved = scene
    look = {"symbol": "plus", "size": 0.5, "labels": ["here"], "orientations": [[0, 2, 0]]}
    factory.add_symbols("marks", [[1, 2, 3]], **look)
    show(0)
    factory.update_symbols("marks", symbol="cross", labels=[])
    show(1)
    factory.update_symbols("marks", size=None, orientations=np.zeros((0, 3)))
    show(2)
    plus, cross, upward = [
        np.array(s) - [1, 2, 3] for _, s in saved("marks", "LineStrips3D:strips")
    ]
    assert not np.allclose(plus, cross)
    assert np.allclose(np.linalg.norm(cross, axis=2), 0.5)
    assert np.allclose(upward[:, :, 2], 0, atol=1e-6)
    assert saved("marks/labels", "Points3D:labels") == [(0, ["here"]), (1, [])]


def test_changed_looks_of_a_wireframe(scene):
    factory, show, saved = scene
    factory.add_mesh("plate", SQUARE, CELLS, color="#00ff00", wireframe=False)
    show(0)
    factory.update_mesh("plate", wireframe=True)
    show(1)
    factory.update_mesh("plate", size=0.25)
    show(2)
    assert saved("plate/edges", "LineStrips3D:colors") == [(1, [0x00FF00FF])]
    assert saved("plate/edges", "LineStrips3D:radii")[-1] == (2, [0.25])


def test_a_body_that_is_shown_again_is_where_it_was(scene):
    factory, show, saved = scene
    factory.add_box("crate", [1, 2, 3], position=[1, 0, 0], label="crate")
    show(0)
    factory.update_box("crate", position=[2, 0, 0])
    factory.update_box("crate", visible=False)
    show(1)
    factory.update_box("crate", visible=True, label=None)
    show(2)
    places = [place for _, (place,) in saved("tf", "Transform3D:translation")]
    assert places[-1] == [2, 0, 0]
    assert saved("crate", "Boxes3D:labels")[-1] == (2, [])


def test_what_lies_below_an_object_stays_when_it_is_hidden(scene):
    factory, show, saved = scene
    factory.add_mesh("foot", SQUARE, CELLS, wireframe=True)
    factory.add_points("foot/contacts", SQUARE)
    show(0)
    factory.update_mesh("foot", visible=False)
    show(1)
    assert saved("foot", "Clear:is_recursive") == [(1, [False])]
    assert saved("foot/edges", "Clear:is_recursive") == [(1, [False])]
    assert saved("foot/contacts", "Clear:is_recursive") == []


def test_of_several_changes_in_a_step_the_last_one_counts(opened):
    visualizer, factory = opened(), Factory()
    factory.add_points("cloud", SQUARE, color="red")
    for step, colors in enumerate([["blue"], ["lime", "white"]]):
        for number, color in enumerate(colors):
            look = {"color": color} if number != 0 or step == 0 else {"color": color, "size": 1}
            factory.update_points("cloud", **look)
        visualizer.events(1, step, factory.take_events())
    factory.update_points("cloud", visible=False)
    factory.update_points("cloud", visible=True)
    visualizer.events(1, 2, factory.take_events())
    visualizer.close()
    rows = []  # in the order that decides between rows of one step
    for chunk in rr.chunk.RrdReader(visualizer.file).stream().filter(content="/env_1/cloud"):
        batch = chunk.to_record_batch()
        found = set(batch.schema.names) & {"Points3D:colors", "Clear:is_recursive"}
        for name in found:
            steps, values = batch.column("step").to_pylist(), batch.column(name).to_pylist()
            rows += [(step, name, value) for step, value in zip(steps, values, strict=True)]
    assert [value for step, _, value in rows if step == 1] == [[0x00FF00FF], [0xFFFFFFFF]]
    assert [value for step, _, value in rows if step == 2] == [[True], [0xFFFFFFFF]]


def test_height_field(scene):
    factory, show, saved = scene
    heights = np.array([[0, 1, 2], [3, 4, 5]])
    factory.add_height_field("hills", heights, [0.5, 2.0], position=[1, 0, 0])
    show(0)
    factory.update_height_field("hills", heights=heights + 1, scalar_field=heights)
    show(1)
    (_, before), (_, after) = saved("hills", "Mesh3D:vertex_positions")
    places = [[0, 0], [0, 2], [0, 4], [0.5, 0], [0.5, 2], [0.5, 4]]
    assert before == [[*place, height] for place, height in zip(places, range(6), strict=True)]
    assert np.array(after)[:, 2].tolist() == [1, 2, 3, 4, 5, 6]
    assert len(saved("hills", "Mesh3D:triangle_indices")[0][1]) == 4
    assert saved("hills", "Mesh3D:vertex_normals")[0][1][0][2] > 0
    assert len(saved("hills", "Mesh3D:vertex_colors")[-1][1]) == 6
    assert saved("tf", "Transform3D:translation") == [(0, [[1, 0, 0]])]


def test_grids_are_drawn_anew_only_when_their_size_changes(scene):
    factory, show, saved = scene
    factory.add_height_field("hills", np.zeros((2, 3)), [1, 1])
    factory.add_slice("cut", np.zeros((2, 3)), [1, 1])
    show(0)
    factory.update_height_field("hills", heights=np.ones((2, 3)))
    factory.update_slice("cut", values=np.ones((2, 3)))
    show(1)
    factory.update_height_field("hills", heights=np.ones((3, 3)))
    factory.update_slice("cut", values=np.ones((3, 3)))
    show(2)
    for name in ("hills", "cut"):
        cells = saved(name, "Mesh3D:triangle_indices")
        assert [(step, len(rows)) for step, rows in cells] == [(0, 4), (2, 8)]
    points = {name: saved(name, "Mesh3D:vertex_positions") for name in ("hills", "cut")}
    assert [step for step, _ in points["hills"]] == [0, 1, 2]
    assert [(step, len(rows)) for step, rows in points["cut"]] == [(0, 6), (2, 9)]


def test_slice_with_limits_and_a_color_bar(scene):
    factory, show, saved = scene
    values = [[0.0, 1.0], [2.0, 9.0]]
    limits = {"vmin": 0.0, "vmax": 2.0}
    factory.add_slice("cut", values, [1, 1], colormap="gray", color_bar=True, **limits)
    show(0)
    factory.update_slice("cut", values=np.zeros((2, 2)))
    show(1)
    factory.update_slice("cut", vmax=4.0)
    show(2)
    colors = saved("cut", "Mesh3D:vertex_colors")
    white, gray, black = 0xFFFFFFFF, 0x808080FF, 0x000000FF
    assert colors[0] == (0, [black, gray, white, white])
    assert colors[1] == (1, [black] * 4)
    bars = saved("cut/color_bar/values", "Points3D:labels")
    assert bars == [(0, ["0", "1", "2  cut"]), (2, ["0", "2", "4  cut"])]
    shades = saved("cut/color_bar", "Mesh3D:vertex_colors")[0][1]
    assert (shades[0], shades[-1]) == (black, white)


def test_volume(scene):
    factory, show, saved = scene
    values = np.arange(24.0).reshape(2, 3, 4)
    factory.add_volume("field", values, [0.1, 0.2, 0.3], colormap="magma", vmax=20)
    show(0)
    factory.update_volume("field", values=values + 1)
    show(1)
    tensors = [tensor for _, (tensor,) in saved("field/slices", "Tensor:data")]
    assert [tensor["shape"] for tensor in tensors] == [[2, 3, 4]] * 2
    assert tensors[1]["buffer"] == (values + 1).ravel().tolist()
    cloud = [tensor for _, (tensor,) in saved("field", "Volume3D:values")]
    assert cloud[0]["shape"] == [4, 3, 2]
    assert cloud[0]["buffer"][:3] == [
        0,
        pytest.approx(12 / 20, abs=1e-3),
        pytest.approx(0.2, abs=1e-3),
    ]
    assert saved("field", "Volume3D:voxel_size")[0][1] == [pytest.approx([0.1, 0.2, 0.3])]


def test_volume_in_a_colormap_that_rerun_lacks(scene):
    factory, show, saved = scene
    factory.add_volume("field", np.zeros((2, 2, 2)), [1, 1, 1], colormap="jet")
    with pytest.warns(UserWarning, match='"jet".*"field" is drawn in viridis'):
        show(0)
    assert saved("field", "Volume3D:values")


def test_image(scene):
    factory, show, saved = scene
    factory.add_image("camera", np.array([[0.0, 1.0]]))
    show(0)
    factory.update_image("camera", np.full((1, 1, 3), 7, np.uint8))
    show(1)
    images = saved("../images/env_1/camera", "Image:buffer")
    assert images == [(0, [[0, 255]]), (1, [[7, 7, 7]])]


def test_hidden_and_removed_objects(scene, arm):
    factory, show, saved = scene
    packages = {"arm_meshes": str(arm.parent / "meshes")}
    factory.add_robot("arm", arm, ["base", "upper"], package_dirs=packages)
    factory.add_points("cloud", SQUARE, size=0.1, visible=False)
    factory.add_box("crate", [1, 1, 1], color="#ff0000")
    show(0)
    factory.update_points("cloud", visible=True)
    factory.update_box("crate", visible=False)
    factory.update_robot("arm", visible=False)
    show(1)
    factory.update_box("crate", visible=True, half_sizes=[2, 2, 2])
    factory.remove("cloud", "arm")
    show(2)
    factory.add_sphere("cloud", 1.0)
    show(3)
    assert [step for step, _ in saved("cloud", "Points3D:positions")] == [1]
    assert saved("cloud", "Clear:is_recursive") == [(2, [True])]
    assert saved("cloud\\ \\(2\\)", "Ellipsoids3D:half_sizes") == [(3, [[1, 1, 1]])]
    assert saved("crate", "Clear:is_recursive") == [(1, [True])]
    assert saved("crate", "Boxes3D:half_sizes") == [(0, [[1, 1, 1]]), (2, [[2, 2, 2]])]
    assert saved("crate", "Boxes3D:colors") == [(0, [0xFF0000FF]), (2, [0xFF0000FF])]
    scales = [scale for _, (scale,) in saved("arm/base_0", "InstancePoses3D:scales")]
    assert scales == [[1, 1, 1], [0, 0, 0], [0, 0, 0]]


def test_text(scene):
    factory, show, saved = scene
    factory.add_text("notes", "# one")
    show(0)
    factory.update_text("notes", content="# two")
    show(1)
    assert saved("notes", "TextDocument:text") == [(0, ["# one"]), (1, ["# two"])]
    assert saved("notes", "TextDocument:media_type") == [(None, ["text/markdown"])]


def test_scalars(scene):
    factory, show, saved = scene
    factory.add_scalars("error", ["x", "y"])
    show(0)
    for step in range(1, 4):
        factory.update_scalars("error", [step, -step])
        show(step)
    assert saved("error", "Scalars:scalars") == [(1, [1, -1]), (2, [2, -2]), (3, [3, -3])]
    assert saved("error", "SeriesLines:names") == [(None, ["x", "y"])]


def test_robot(scene, arm):
    factory, show, saved = scene
    poses = np.array([[0, 0, 0, 0, 0, 0, 1], [0, 0, 1, 0, 0, 1, 0]], float)
    packages = {"arm_meshes": str(arm.parent / "meshes")}
    factory.add_robot("arm", arm, ["base", "upper"], package_dirs=packages, poses=poses)
    show(0)
    factory.update_robot("arm", poses=poses + 1)
    show(1)
    ((_, base),) = saved("arm/base_0", "CoordinateFrame:frame")
    assert saved("arm/base_0", "Boxes3D:half_sizes")[0][1] == [pytest.approx([0.1, 0.1, 0.05])]
    assert saved("arm/upper_0", "Cylinders3D:colors") == [(0, [0xFF8000FF])]
    ((_, upper),) = saved("arm/tool_0", "CoordinateFrame:frame")
    assert saved("arm/upper_0", "CoordinateFrame:frame") == [(None, upper)]
    assert saved("arm/tool_0", "Asset3D:media_type") == [(None, ["model/obj"])]
    assert saved("arm/tool_0", "InstancePoses3D:scales") == [(0, [[2, 2, 2]])]
    assert saved("arm/tool_0", "InstancePoses3D:translations")[0][1] == [pytest.approx([0, 0, 0.3])]
    assert saved("arm/tool_0", "Asset3D:albedo_factor") == []
    frames = [(0, base), (0, upper)]
    assert saved("tf", "Transform3D:child_frame")[:2] == frames
    assert saved("tf", "Transform3D:translation")[1:3] == [(0, [[0, 0, 1]]), (1, [[1, 1, 1]])]


def test_ghost_of_a_robot(scene, arm):
    factory, show, saved = scene
    packages = {"arm_meshes": str(arm.parent / "meshes")}
    factory.add_robot(
        "ghost", arm, ["base", "upper"], package_dirs=packages, color="#0000ff", alpha=0.4
    )
    show(0)
    factory.update_robot("ghost", alpha=1.0)
    show(1)
    expected = [(0, [0x0000FF66]), (1, [0x0000FFFF])]
    assert saved("ghost/tool_0", "Asset3D:albedo_factor") == expected
    assert saved("ghost/base_0", "Boxes3D:colors") == expected
    # Without poses it stands with its joints at zero.
    assert saved("tf", "Transform3D:translation")[1] == (0, [[0, 0, pytest.approx(0.05)]])


def test_missing_meshes_are_warned_of(scene, arm):
    factory, show, saved = scene
    factory.add_robot("arm", arm, ["base", "upper"])
    with pytest.warns(UserWarning, match=r"1 meshes of .*arm\.urdf.*tool\.obj.*package_dirs"):
        show(0)
    assert saved("arm/tool_1", "Ellipsoids3D:half_sizes")


def test_collision_shapes_are_left_out(opened, entities, arm):
    visualizer, factory = opened(), Factory()
    packages = {"arm_meshes": str(arm.parent / "meshes")}
    factory.add_robot("arm", arm, ["base", "upper"], package_dirs=packages)
    visualizer.events(1, 0, factory.take_events())
    visualizer.close()
    shapes = {entity for entity in entities(visualizer.file) if entity.startswith("/env_1/arm/")}
    names = {"base_0", "upper_0", "tool_0", "tool_1"}
    assert shapes == {f"/env_1/arm/{name}" for name in names}


def test_names_with_blanks_and_groups(scene):
    factory, show, saved = scene
    factory.add_points("left foot/contact (N)", SQUARE)
    show(0)
    entity = "left\\ foot/contact\\ \\(N\\)"
    assert len(saved(entity, "Points3D:positions")) == 1


def test_every_kind_of_the_scene_is_known(opened):
    visualizer = opened()
    for kind in KINDS.keys() - {"markers"}:  # which reach viewers as symbols
        with pytest.raises(VisualizerError, match="not added"):
            visualizer.events(1, 0, [Event("update", kind, ("nobody",), {})])
    with pytest.raises(VisualizerError, match="unknown kind"):
        visualizer.events(1, 0, [Event("add", "smoke", ("cloud",), {})])


def test_instances_have_their_own_entities(opened, read):
    visualizer = opened(instance_nb=2)
    for instance in (1, 2):
        factory = Factory()
        factory.add_sphere("ball", 0.1, position=[instance, 0, 0])
        factory.add_scalars("height", ["z"], values=[instance])
        visualizer.events(instance, 0, factory.take_events())
    visualizer.close()
    for instance in (1, 2):
        path = visualizer.file, f"/env_{instance}/tf", "Transform3D:translation"
        assert read(*path) == [(0, [[instance, 0, 0]])]
        names = read(visualizer.file, f"/env_{instance}/height", "SeriesLines:names")
        assert names == [(None, [f"{instance}: z"])]


def test_instances_beyond_the_limit_only_record_numbers(opened, entities):
    visualizer = opened(instance_nb=3, max_instances=1)
    for instance in (1, 2, 3):
        factory = Factory()
        factory.add_sphere("ball", 0.1)
        factory.add_scalars("height", ["z"], values=[0.0])
        visualizer.events(instance, 0, factory.take_events())
        factory.update_sphere("ball", position=[0, 0, 1])
        visualizer.events(instance, 1, factory.take_events())
    visualizer.close()
    drawn = entities(visualizer.file)
    assert {"/env_1/ball", "/env_1/height", "/env_2/height", "/env_3/height"} <= drawn
    assert not {"/env_2/ball", "/env_3/ball"} & drawn


def test_many_steps_make_few_chunks(opened):
    visualizer, factory = opened(), Factory()
    for number in range(20):
        factory.add_box(f"box {number}", [1, 1, 1])
    factory.add_scalars("error", ["x"])
    factory.add_points("cloud", SQUARE)
    for step in range(500):
        for number in range(20):
            factory.update_box(f"box {number}", position=[step, number, 0])
        factory.update_scalars("error", [step])
        factory.update_points("cloud", positions=SQUARE + step)
        visualizer.events(1, step, factory.take_events())
    visualizer.close()
    chunks = list(rr.chunk.RrdReader(visualizer.file).stream())
    temporal = [chunk for chunk in chunks if "step" in chunk.to_record_batch().schema.names]
    poses = [chunk for chunk in temporal if chunk.entity_path == "/env_1/tf"]
    # 22 looks of new objects, and 3 chunks for each flush: of 100 steps, or of 0.2 s.
    assert len(temporal) < 22 + 3 * 40
    assert sum(chunk.to_record_batch().num_rows for chunk in poses) == 500 * 20 + 20
