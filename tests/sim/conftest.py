from __future__ import annotations

import pytest

from physx_core import plugins
from physx_sim import Robot, World
from physx_sim.engines import example_data_dir, example_robot

BACKENDS = ("dart", "pinocchio")

BAR = """
<robot name="bar">
  <link name="base"/>
  <joint name="hinge" type="{kind}">
    <parent link="base"/><child link="bar"/><axis xyz="0 1 0"/>
    {extra}
  </joint>
  <link name="bar">
    <inertial>
      <origin xyz="0 0 -0.5"/><mass value="2"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="tip_joint" type="fixed">
    <origin xyz="0 0 -1"/><parent link="bar"/><child link="tip"/>
  </joint>
  <link name="tip"/>
</robot>
"""

BRICK = """
<robot name="brick">
  <link name="brick">
    <inertial>
      <origin xyz="0.1 0 0.05"/><mass value="2"/>
      <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0.01" ixz="0" iyz="0"/>
    </inertial>
  </link>
</robot>
"""


@pytest.fixture(params=BACKENDS)
def backend(request):
    return plugins.resolve("backend", request.param)


@pytest.fixture
def dart():
    return plugins.resolve("backend", "dart")


@pytest.fixture
def pinocchio():
    return plugins.resolve("backend", "pinocchio")


@pytest.fixture
def write_urdf(tmp_path):
    def write(text, name="robot.urdf"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def bar(write_urdf):
    """Write a pendulum with one joint; its moment of inertia is 0.6 kg m², and 1e-9 of the tip."""

    def make(extra="", kind="continuous", **options):
        name = options.get("name", "bar")
        path = write_urdf(BAR.format(kind=kind, extra=extra), f"{name}.urdf")
        return Robot(path, **options)

    return make


@pytest.fixture
def brick(write_urdf):
    """A single floating body."""
    return World([Robot(write_urdf(BRICK), fixed_base=False)])


@pytest.fixture(scope="session")
def example():
    """Return a robot of example-robot-data by the name of its file."""
    if example_data_dir() is None:
        pytest.skip("example-robot-data is not installed")
    return example_robot


@pytest.fixture(params=(*BACKENDS, "mujoco"))
def engine(request):
    """Each of the three engines."""
    if request.param == "mujoco":
        pytest.importorskip("mujoco")
    return plugins.resolve("backend", request.param)
