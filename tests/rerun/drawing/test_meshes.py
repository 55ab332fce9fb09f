"""Extents of mesh files, also of damaged and malicious ones."""

from __future__ import annotations

import io
import json
import struct
import zipfile

import numpy as np
import pytest

from physx_rerun.drawing.meshes import corners_of_mesh
from physx_rerun.drawing.triangles import simple_mesh

UNKNOWN = [[0, 0, 0]]
TEXT = """solid a
facet normal 0 0 1
outer loop
vertex -1 0 0
vertex 1 0 0
vertex 0 1 2
endloop
endfacet
endsolid"""
DOCUMENT = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.5"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="shape"><mesh>
<source id="points"><float_array id="numbers">-1 0 0 1 0 0 0 1 2</float_array><technique_common>
<accessor source="#numbers" count="3" stride="3"><param name="X"/><param name="Y"/>
<param name="Z"/></accessor></technique_common></source>
<vertices id="corners"><input semantic="POSITION" source="#points"/></vertices>
<polylist><input semantic="VERTEX" source="#corners" offset="0"/>
<vcount>{corners}</vcount><p>0 1 2</p></polylist></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="scene"><node id="moved"><translate>0 0 {up}</translate>
<node id="turned"><rotate>0 0 1 90</rotate>{instance}</node></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#scene"/></scene></COLLADA>"""
SHAPE = '<instance_geometry url="#shape"/>'
PAINTED = """<instance_geometry url="#shape"><bind_material><technique_common>
<instance_material symbol="a" target="#missing"/></technique_common></bind_material>
</instance_geometry>"""


def document(corners="3", up=2, instance=SHAPE):
    return DOCUMENT.format(corners=corners, up=up, instance=instance).encode()


def gltf(*nodes):
    """Return a text whose first node is the root, and whose mesh reaches from -1 to 1, 1 and 2."""
    return json.dumps(
        {
            "scenes": [{"nodes": [0]}],
            "nodes": nodes,
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "accessors": [{"count": 10**12, "min": [-1, 0, 0], "max": [1, 1, 2]}],
        }
    ).encode()


def binary(content):
    header = struct.pack("<4sIIII", b"glTF", 2, 20 + len(content), len(content), 0x4E4F534A)
    return header + content


def packed(content):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("model.dae", content)
    return file.getvalue()


QUARTER = [0, 0, 0.5**0.5, 0.5**0.5]
TURNED = [{"translation": [0, 0, 1], "children": [1]}, {"rotation": QUARTER, "mesh": 0}]
MATRIX = [{"matrix": np.diag([2.0, 2, 2, 1]).tolist()[0] + [0, 2, 0, 0, 0, 0, 2, 0, 5, 0, 0, 1]}]


@pytest.mark.parametrize(
    ("name", "content", "corners"),
    [
        ("text.stl", TEXT.encode(), [[-1, 0, 0], [1, 1, 2]]),
        (
            "points.obj",
            b"# v 9 9 9\nv -1 0 0\nvn 5 5 5\nv 1 1 2\nv nan 0 0",
            [[-1, 0, 0], [1, 1, 2]],
        ),
        ("placed.dae", document(), [[-0.5, -0.5, 1], [0, 0.5, 2]]),
        ("unpainted.dae", document(instance=PAINTED), [[-0.5, 0, 0], [0.5, 0.5, 1]]),
        ("placed.gltf", gltf(*TURNED), [[-1, -1, 1], [0, 1, 3]]),
        ("scaled.glb", binary(gltf({**MATRIX[0], "mesh": 0})), [[3, 0, 0], [7, 2, 4]]),
    ],
)
def test_extents_of_every_format(name, content, corners, tmp_path):
    (tmp_path / name).write_bytes(content)
    assert corners_of_mesh(tmp_path / name) == pytest.approx(np.array(corners), abs=1e-6)


BOMB = b'<!DOCTYPE a [<!ENTITY b "c"><!ENTITY d "&b;&b;">]>'


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("cut.stl", bytes(83)),
        ("cut.dae", document()[:-100]),
        ("cut.glb", binary(gltf(*TURNED))[:-9]),
        ("packed.dae", packed(document())),
        ("appended.dae", document() + packed(document())),
        ("entities.dae", document().replace(b"<COLLADA", BOMB + b"<COLLADA")),
        ("utf16.dae", document().decode().replace("?>", ' encoding="utf-16"?>').encode("utf-16")),
        ("nested.dae", document(instance='<instance_node url="#moved"/>')),
        ("tags.dae", document(instance="<a/>" * 2**20)),
        ("items.gltf", gltf(*TURNED, {"extras": [[]] * 2**20})),
        ("cycle.gltf", gltf({"children": [0, 0]})),
        ("unknown.ply", b"ply"),
    ],
)
def test_damaged_and_malicious_files_have_no_extent(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    assert corners_of_mesh(tmp_path / name).tolist() == UNKNOWN


def test_a_document_that_repeats_its_shapes_without_end_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "repeated.dae"
    path.write_bytes(document(instance=100 * SHAPE))
    monkeypatch.setattr("physx_rerun.drawing.meshes._MOST", 200)
    assert corners_of_mesh(path).tolist() == UNKNOWN


def test_polygons_with_more_corners_than_there_are_allocate_nothing(tmp_path):
    path = tmp_path / "polygons.dae"
    path.write_bytes(document(corners="1900000000"))
    assert simple_mesh(path, 0.1) is None
    assert len(corners_of_mesh(path)) == 2
