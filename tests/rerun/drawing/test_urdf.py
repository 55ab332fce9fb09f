from __future__ import annotations

import numpy as np
import pytest

from physx_core.errors import VisualizerError
from physx_rerun.drawing.robot import read_model


def read(urdf, bodies, packages):
    return read_model({"urdf": urdf, "bodies": bodies, "package_dirs": packages})


def test_shapes_sit_on_their_bodies(arm):
    model = read(arm, ["base", "upper"], {"arm_meshes": str(arm.parent / "meshes")})
    shapes = {shape.name: shape for shape in model.shapes}
    assert set(shapes) == {"base_0", "upper_0", "tool_0", "tool_1"}
    assert model.missing == []
    assert shapes["base_0"].size == (0.1, 0.1, 0.05)
    assert shapes["upper_0"].color == (1, 0.5, 0, 1)
    # The tool is no body of its own: it moves with the link that it is mounted on.
    assert shapes["tool_0"].body == 1
    np.testing.assert_allclose(shapes["tool_0"].pose[:3, 3], [0, 0, 0.3])
    np.testing.assert_allclose(model.rest[1], [0, 0, 0.05, 0, 0, 0, 1], atol=1e-12)


def test_a_package_is_found_beside_the_file(arm, tmp_path):
    model_folder = tmp_path / "arm_meshes" / "urdf"
    model_folder.mkdir(parents=True)
    (tmp_path / "arm_meshes" / "tool.obj").write_text("v 0 0 0\n")
    (model_folder / "arm.urdf").write_text(arm.read_text())
    assert read(model_folder / "arm.urdf", ["base"], {}).missing == []


def test_a_missing_mesh_is_listed(arm):
    model = read(arm, ["base"], {})
    assert model.missing == ["package://arm_meshes/tool.obj"]


@pytest.mark.parametrize("text", ["", "<robot", None])
def test_unreadable_files(tmp_path, text):
    path = tmp_path / "robot.urdf"
    if text is not None:
        path.write_text(text)
    with pytest.raises(VisualizerError, match=r"robot\.urdf"):
        read(path, [], {})


def test_unknown_bodies_and_shapes(arm):
    with pytest.raises(VisualizerError, match="'elbow'.*upper"):
        read(arm, ["elbow"], {})
    arm.write_text('<robot name="r"><link name="a"><visual><geometry><cone/></geometry></visual>'
                   "</link></robot>")  # fmt: skip
    with pytest.raises(VisualizerError, match="cone"):
        read(arm, ["a"], {})
