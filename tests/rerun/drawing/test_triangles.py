"""Meshes of few triangles, made from files of many."""

from __future__ import annotations

import numpy as np
import pytest

from physx_rerun.drawing.triangles import simple_mesh

WAVES = 60
DOCUMENT = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.5"/><up_axis>Z_UP</up_axis></asset>
<library_effects><effect id="paint"><profile_COMMON><technique sid="common"><phong>
<diffuse>{diffuse}</diffuse></phong></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="red"><instance_effect url="#paint"/></material></library_materials>
<library_geometries><geometry id="shape"><mesh>
<source id="points"><float_array id="numbers">{points}</float_array><technique_common>
<accessor source="#numbers" count="1891" stride="3"><param name="X"/><param name="Y"/>
<param name="Z"/></accessor></technique_common></source>
<vertices id="corners"><input semantic="POSITION" source="#points"/></vertices>
<polylist material="paint">
<input semantic="VERTEX" source="#corners" offset="0"/><vcount>{counts}</vcount><p>{cells}</p>
</polylist></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="scene"><node id="plate"><translate>0 0 2</translate>
<rotate>0 0 1 90</rotate><instance_geometry url="#shape"><bind_material><technique_common>
<instance_material symbol="paint" target="#red"/></technique_common></bind_material>
</instance_geometry></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#scene"/></scene>
</COLLADA>"""


def quads():
    """Return a square of 60 x 30 squares in the plane of x and y, 2 long and 1 wide."""
    x, y = np.meshgrid(np.arange(WAVES + 1), np.arange(31), indexing="ij")
    points = np.stack([x / 30, y / 30, 0 * x], axis=-1).reshape(-1, 3)
    first = (x[:-1, :-1] * 31 + y[:-1, :-1]).ravel()
    return points, np.stack([first, first + 31, first + 32, first + 1], axis=1)


def collada(path, diffuse="<color>0.5 0 0 1</color>"):
    def text(values):
        return " ".join(map(str, np.ravel(values)))

    points, cells = quads()
    counts = np.full(len(cells), 4)
    content = DOCUMENT.format(
        diffuse=diffuse, points=text(points), counts=text(counts), cells=text(cells)
    )
    path.write_text(content)
    return path


def stl(path, triangles):
    rows = np.zeros(len(triangles), [("numbers", "<f4", (4, 3)), ("attribute", "<u2")])
    rows["numbers"][:, 1:] = triangles
    path.write_bytes(bytes(80) + len(rows).to_bytes(4, "little") + rows.tobytes())
    return path


def sphere(radius=1.0, count=40):
    """Return the triangles of a sphere, shape (n, 3, 3)."""
    up, round_ = np.linspace(0, np.pi, count), np.linspace(0, 2 * np.pi, count)
    u, v = np.meshgrid(up, round_, indexing="ij")
    points = np.stack([np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    halves = np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)
    return radius * np.concatenate([half.reshape(-1, 3, 3) for half in halves])


def test_a_mesh_keeps_its_form_but_not_its_details(tmp_path):
    triangles = sphere()
    mesh = simple_mesh(stl(tmp_path / "sphere.stl", triangles), 0.2)
    assert len(mesh.cells) < len(triangles) / 4
    assert np.linalg.norm(mesh.positions, axis=1) == pytest.approx(1, abs=0.1)
    outwards = np.einsum("ij,ij->i", mesh.normals, mesh.positions)
    assert (outwards[np.unique(mesh.cells)] > 0.8).all()
    assert (mesh.colors == 1).all()


def test_the_two_faces_of_a_thin_wall_become_the_outer_one(tmp_path):
    inner = sphere(0.999)[:, ::-1]
    mesh = simple_mesh(stl(tmp_path / "shell.stl", np.concatenate([sphere(), inner])), 0.2)
    drawn = mesh.normals[mesh.cells[:, 0]]
    assert (np.einsum("ij,ij->i", drawn, mesh.positions[mesh.cells[:, 0]]) > 0).mean() > 0.9


def test_a_document_is_placed_and_colored_as_it_says(tmp_path):
    mesh = simple_mesh(collada(tmp_path / "plate.dae"), 0.1)
    assert np.ptp(mesh.positions, axis=0) == pytest.approx([0.5, 1.0, 0.0], abs=0.11)
    assert mesh.positions.mean(axis=0) == pytest.approx([-0.25, 0.5, 1.0], abs=0.05)
    assert np.abs(mesh.normals[:, 2]) == pytest.approx(1)
    assert np.unique(mesh.colors, axis=0)[0] == pytest.approx([0.735, 0, 0, 1], abs=1e-3)
    edges = np.diff(mesh.positions[mesh.cells], axis=1)
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    assert areas.sum() / 2 == pytest.approx(0.5, rel=0.2)


@pytest.mark.parametrize(
    ("old", "new"), [("", ""), ("Z_UP", "Y_UP"), ("instance_material", "extra")]
)
def test_documents_can_be_read_completely(old, new, tmp_path):
    path = collada(tmp_path / "plate.dae")
    path.write_text(path.read_text().replace(old, new))
    mesh = simple_mesh(path, None)
    assert mesh.cells.shape == (2 * 60 * 30, 3)
    corners = [mesh.positions.min(axis=0), mesh.positions.max(axis=0)]
    assert np.allclose(corners, [[-0.5, 0, 1], [0, 1, 1]], atol=1e-6)
    assert len(simple_mesh(path, 0.1).cells) < 2 * 60 * 30 / 4


def test_other_files_are_left_to_the_viewer(tmp_path):
    (tmp_path / "text.stl").write_text("solid\nendsolid\n")
    (tmp_path / "damaged.dae").write_text("<COLLADA><asset/>")
    (tmp_path / "entities.dae").write_text('<!DOCTYPE x [<!ENTITY a "a">]><COLLADA/>')
    collada(tmp_path / "textured.dae", '<texture texture="picture" texcoord="at"/>')
    stl(tmp_path / "small.stl", sphere(count=6))
    stl(tmp_path / "huge.stl", 1e9 * sphere())
    names = (
        "text.stl damaged.dae entities.dae textured.dae small.stl huge.stl missing.stl other.obj"
    )
    for name in names.split():
        assert simple_mesh(tmp_path / name, 0.01) is None, name
