"""Models of robots as engines get them, without an engine."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from physx_sim import Mesh, Robot, World
from physx_sim.engines import RobotBackend, named_robots, read_parts, read_robot
from physx_sim.errors import ModelError

TEXT = """
<robot name="crane">
  <link name="base"/>
  <link name="hook">
    <inertial><origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/><mass value="4"/>
      <inertia ixx="1" iyy="2" izz="3" ixy="0.1" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="cart"><inertial><mass value="5"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="rail" type="prismatic"><origin xyz="0 0 2"/><parent link="base"/>
    <child link="cart"/><axis xyz="0 3 4"/><limit lower="-1" upper="2" effort="9" velocity="8"/>
  </joint>
  <joint name="weld" type="fixed"><origin rpy="0 0 1.5707963267948966"/><parent link="cart"/>
    <child link="hook"/></joint>
</robot>
"""


def test_links_are_rigid_bodies_in_the_order_of_the_tree(tmp_path):
    path = tmp_path / "crane.urdf"
    path.write_text(TEXT, encoding="utf-8")
    model = read_robot(Robot(path, mass_factors={"hook": 2.0}))
    base, cart, hook = model.bodies
    assert [body.name for body in (base, cart, hook)] == list(model.links)
    assert [body.parent for body in (base, cart, hook)] == [-1, 0, 1]
    assert (base.mass, base.joint, hook.joint) == (1e-9, None, None)
    assert cart.joint is not None and cart.joint.name == "rail"
    assert (cart.joint.unit, cart.joint.lower, cart.joint.max_velocity) == ("m", -1.0, 8.0)
    np.testing.assert_allclose(cart.axis, [0.0, 0.6, 0.8])
    np.testing.assert_allclose(cart.pose[:3, 3], [0.0, 0.0, 2.0])
    turned = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(hook.pose[:3, :3], turned, atol=1e-15)
    np.testing.assert_allclose(hook.center, [1.0, 2.0, 3.0])
    assert hook.mass == 8.0
    expected = [[4, -0.2, 0], [-0.2, 2, 0], [0, 0, 6]]  # twice that of the file, turned
    np.testing.assert_allclose(hook.inertia, expected, atol=1e-14)


@pytest.mark.parametrize("name", [name for name in named_robots() if "/" not in name])
def test_every_robot_of_physx_is_read(name):
    parts = read_parts(World([Robot(name, fixed_base=False)]))
    bodies = parts.movables[0].model.bodies
    joints = [body.joint for body in bodies if body.joint is not None]
    assert tuple(joints) == parts.movables[0].model.joints
    for body in bodies:
        assert np.linalg.norm(body.axis) == pytest.approx(1.0 if body.joint else 0.0)


@pytest.mark.slow
def test_a_backend_knows_the_robots_of_physx_by_name():
    class Nothing(RobotBackend):
        def build(self, world, seed=None):
            raise NotImplementedError

    assert {"cartpole", "ant"} <= {info.name for info in Nothing().robots()}
    path = Nothing().robot_path("cartpole")
    assert path is not None and path.is_file()
    assert Nothing().robot_path("no such robot") is None


def test_meshes_without_their_library_say_what_to_install(tmp_path, monkeypatch):
    path = tmp_path / "mesh.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", encoding="ascii")
    monkeypatch.setitem(sys.modules, "coal", None)
    with pytest.raises(ModelError, match=r"package coal.*physx.sim\[meshes\]"):
        read_parts(World(objects=[Mesh(name="m", path=path, mass=1.0)]))
