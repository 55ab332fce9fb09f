"""Loading of URDF files: errors of broken ones, meshes, and the order of joints."""

from __future__ import annotations

import importlib.metadata

import numpy as np
import pytest

from physx_core.errors import ConfigError
from physx_sim import Robot, World, mesh_path
from physx_sim.engines import example_robot, read_robot
from physx_sim.errors import MissingMeshesError, ModelError

LINK = '<link name="{}"/>'
JOINT = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/>{}</joint>'


def robot(*parts):
    return f"<robot name='r'>{''.join(parts)}</robot>"


def chain(kind="continuous", extra=""):
    return robot(LINK.format("a"), LINK.format("b"), JOINT.format("j", kind, "a", "b", extra))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<robot name='r'><link name='a'>", "not valid XML"),
        ("not xml", "not valid XML"),
        ("<sdf/>", 'root element is "sdf"'),
        ('<!DOCTYPE r [<!ENTITY a "b">]><robot/>', "DOCTYPE"),
        ("<robot name='r'/>", "no link"),
        (robot(LINK.format("a"), LINK.format("a")), "used twice"),
        (robot(LINK.format("a"), LINK.format("b")), "need.* one root link.*a, b"),
        (robot(LINK.format("a"), JOINT.format("j", "fixed", "a", "x", "")), 'child "x".*links: a'),
        (chain("ball"), 'type "ball"'),
        (chain("floating"), 'type "floating"'),
        (chain("revolute", '<limit lower="0" upper="x" effort="1" velocity="1"/>'), 'upper="x"'),
        (chain("revolute", '<limit effort="-1" velocity="1"/>'), 'effort="-1"'),
        (chain("continuous", '<axis xyz="0 0 0"/>'), 'axis "0 0 0"'),
        (chain("fixed"), "no movable joint"),
        (
            robot(
                *(LINK.format(name) for name in "abc"),
                JOINT.format("j", "fixed", "a", "b", ""),
                JOINT.format("k", "fixed", "b", "c", ""),
                JOINT.format("l", "fixed", "c", "a", ""),
            ),
            "cycle",
        ),
        (
            robot(
                *(LINK.format(name) for name in "abc"),
                JOINT.format("k", "fixed", "b", "c", ""),
                JOINT.format("l", "fixed", "c", "b", ""),
            ),
            "links b, c form a cycle",
        ),
        (
            robot(
                *(LINK.format(name) for name in "abc"),
                JOINT.format("k", "fixed", "a", "c", ""),
                JOINT.format("l", "fixed", "b", "c", ""),
            ),
            '"c" is the child of two joints',
        ),
    ],
)
def test_a_broken_file_is_an_error_with_its_cause(backend, write_urdf, text, words):
    path = write_urdf(text)
    with pytest.raises(ModelError, match=words) as caught:
        backend.build(World([Robot(path)]))
    assert str(path) in str(caught.value)


def test_a_missing_file_is_named(backend, tmp_path):
    with pytest.raises(ModelError, match=r"no URDF file .*nowhere\.urdf"):
        backend.build(World([Robot(tmp_path / "nowhere.urdf")]))
    with pytest.raises(ModelError, match="cannot be read"):
        backend.build(World([Robot(tmp_path)]))


def test_relative_paths_work(backend, bar, monkeypatch):
    path = bar().urdf
    monkeypatch.chdir(path.parent)
    backend.build(World([Robot(path.name)])).close()


def test_a_root_link_world_is_welded(backend, write_urdf, bar):
    path = write_urdf(bar().urdf.read_text().replace('"base"', '"world"'), "world.urdf")
    with backend.build(World([Robot(path)])) as simulation:
        assert simulation.layout.bodies[0] == "world"
        assert simulation.body_poses(["world"]).tolist() == [[0, 0, 0, 0, 0, 0, 1]]
    with pytest.raises(ModelError, match="fixed_base=True"):
        backend.build(World([Robot(path, fixed_base=False)]))


SHAPES = """
<robot name="r"><link name="a">
  <visual><geometry><mesh filename="package://shapes/one.dae"/></geometry></visual>
  <visual><geometry><mesh filename="two.stl"/></geometry></visual>
  <visual><geometry><mesh filename="two.stl"/></geometry></visual>
  <collision><geometry><mesh filename="package://nobody/three.obj"/></geometry></collision>
  <collision><geometry><mesh filename="file:///four%20.obj"/></geometry></collision>
</link></robot>
"""


def test_all_missing_collision_meshes_are_named_in_one_error(backend, write_urdf):
    with pytest.raises(MissingMeshesError) as caught:
        backend.build(World([Robot(write_urdf(SHAPES), fixed_base=False)]))
    names = ["package://nobody/three.obj", "file:///four%20.obj"]
    assert caught.value.missing == names
    assert all(name in str(caught.value) for name in names)


def test_a_mesh_that_is_only_drawn_may_be_missing(write_urdf):
    robot = Robot(write_urdf(SHAPES), fixed_base=False, collisions="none")
    text = " ".join(read_robot(robot).warnings)
    assert "4 mesh file(s) do not exist" in text and "two.stl" in text


@pytest.mark.parametrize(
    "place", ["nobody", "models/nobody", "models/arm/nobody", "", "models", "models/arm/urdf"]
)
def test_a_mesh_is_found_where_a_person_finds_it(tmp_path, place):
    """In a package around or beside the file, or in one whose folder has another name."""
    path, mesh = tmp_path / "models/arm/urdf/arm.urdf", tmp_path / place / "three.obj"
    for file in (path, mesh):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("")
    assert mesh_path(path, "package://nobody/three.obj", {}) == mesh
    assert mesh_path(path, "package://nobody/four.obj", {}) is None


def test_habits_of_files_are_accepted_with_a_warning(backend, write_urdf):
    limits = '<limit lower="1" upper="0" effort="1" velocity="1"/>'
    mimic = '<mimic joint="a" multiplier="0"/>'
    text = robot(
        *(LINK.format(name) for name in ("base", "left", "right")),
        JOINT.format("a", "revolute", "base", "left", limits),
        JOINT.format("b", "continuous", "base", "right", mimic),
    )
    path = write_urdf(f'\n <?xml version="1.0"?>{text}')
    said = " ".join(read_robot(Robot(path)).warnings)
    assert "so there is none: joints a" in said and "multiplier 0 move freely: b" in said
    with (
        pytest.warns(UserWarning, match="above the upper|follow others"),
        backend.build(World([Robot(path, type(backend).__name__)])) as simulation,
    ):
        assert np.isinf(simulation.layout.lower).all()


def test_meshes_are_found_in_packages_and_beside_the_file(backend, write_urdf, tmp_path):
    text = SHAPES.replace("package://nobody/three.obj", f"file://{tmp_path}/three.obj")
    text = text.replace("file:///four%20.obj", f"package://{tmp_path.name}/four.obj")
    path = write_urdf(text)
    (tmp_path / "else").mkdir()
    for name in ("else/one.dae", "two.stl", "three.obj", "four.obj"):
        (tmp_path / name).write_text("")
    world = World([Robot(path, fixed_base=False, package_dirs={"shapes": tmp_path / "else"})])
    backend.build(world).close()


def test_joints_are_in_the_order_of_the_tree(backend, write_urdf):
    links = [LINK.format(name) for name in ("d", "c", "b", "a", "root")]
    joints = [
        JOINT.format("z", "continuous", "root", "a", ""),
        JOINT.format("m", "continuous", "root", "b", ""),
        JOINT.format("y", "prismatic", "b", "c", '<limit effort="1" velocity="1"/>'),
        JOINT.format("k", "revolute", "b", "d", '<limit effort="1" velocity="1"/>'),
    ]
    with backend.build(World([Robot(write_urdf(robot(*links, *joints)))])) as simulation:
        assert simulation.layout.joints == ("m", "k", "y", "z")
        assert simulation.layout.bodies == ("root", "b", "d", "c", "a")
        simulation.set_state([1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0])
        assert simulation.positions().tolist() == [1, 2, 3, 4]
        assert simulation.velocities().tolist() == [5, 6, 7, 8]


def test_duplicate_names_of_robots_are_rejected(bar):
    with pytest.raises(ConfigError, match="distinct names"):
        World([bar(), bar()])


def test_a_missing_package_of_robots_is_named_with_its_pip_line(monkeypatch):
    found = importlib.metadata.distribution

    def missing(name):
        if name == "physx-core":  # tells where to install from
            return found(name)
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", missing)
    with pytest.raises(ModelError, match=r'pip install .*physx.sim\[robots\]"'):
        example_robot("panda_description/urdf/panda.urdf")


def test_an_unknown_robot_of_the_package_is_an_error(example):
    with pytest.raises(ModelError, match="has no robot nobody"):
        example("nobody.urdf")
