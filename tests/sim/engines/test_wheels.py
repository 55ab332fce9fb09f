"""Wheels that roll without slip: paths, accelerations, what they resist, and where they do not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from physx_core import plugins
from physx_core.errors import ConfigError
from physx_sim import (
    BodySettings,
    Connect,
    Ground,
    HeightField,
    JointSettings,
    Robot,
    Wheel,
    World,
    Wrench,
)
from physx_sim.engines import read_robot
from physx_sim.errors import FeatureNotSupportedError, ModelError, SimulationError

pytestmark = pytest.mark.processes

LINK = (
    '<link name="{}"><inertial><origin xyz="{} 0 0"/><mass value="{}"/>'
    '<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}" type="{1}"><parent link="base"/><child link="{0} {2}"/>'
    '<origin xyz="{3}"/><axis xyz="0 1 0"/></joint>'
)
CART = "".join(
    [
        LINK.format("base", 0.05, 5, 0.1, 0.1, 0.2),
        *(LINK.format(f"{side} wheel", 0, 0.5, 0.002, 0.003, 0.002) for side in ("left", "right")),
        JOINT.format("left", "continuous", "wheel", "0 0.2 0"),
        JOINT.format("right", "continuous", "wheel", "0 -0.2 0"),
        '<link name="front caster"/>',
        JOINT.format("front", "fixed", "caster", "0.3 0 -0.05"),
    ]
)
FEET = {"left wheel": 0.1, "right wheel": 0.1, "front caster": 0.05}
"""What touches the ground, and its radius; the caster slides."""


@pytest.fixture
def cart(write_urdf):
    """Return carts with two wheels, 0.4 m apart, and a caster."""

    def make(lateral=True, **options):
        wheels = [Wheel(f"{side} wheel", 0.1, lateral=lateral) for side in ("left", "right")]
        path = write_urdf(f'<robot name="cart">{CART}</robot>', "cart.urdf")
        given = {"position": (0.0, 0.0, 0.1), "wheels": wheels, "friction": 0.0, **options}
        return Robot(path, fixed_base=False, feet=FEET, **given)

    return make


def build(robot, **options):
    world = World([robot], **{"ground": Ground(), **options})
    return plugins.resolve("backend", "pinocchio").build(world)


@pytest.mark.parametrize("mode", ["velocity", "servo"])
@pytest.mark.reported("jiminy#66", about="a wheel that does not slip, as a constraint")
def test_the_speeds_of_two_wheels_decide_on_the_circle(cart, mode):
    joints = {side: JointSettings(mode) for side in ("left", "right")}
    speeds = {"left": 4.0, "right": 7.0}
    with build(cart(joints=joints)) as simulation:
        simulation.set_commands([speeds[joint] for joint in simulation.layout.joints])
        path = []
        for _ in range(40):
            simulation.step(50)
            path.append(simulation.positions()[:2])
        turned = simulation.positions()[3:7]
    slow, fast = 0.1 * 4.0, 0.1 * 7.0
    radius = 0.4 / 2 * (fast + slow) / (fast - slow)
    yaw = (fast - slow) / 0.4 * 2.0
    assert 2 * math.atan2(turned[2], turned[3]) == pytest.approx(yaw, rel=1e-6)
    found = np.linalg.norm(np.array(path) - [0.0, radius], axis=1)
    np.testing.assert_allclose(found, radius, rtol=3e-3)


def test_a_disk_rolls_down_a_ramp(write_urdf):
    mass, spin, radius, slope = 2.0, 0.03, 0.1, 0.3
    text = f'<robot name="disk">{LINK.format("disk", 0, mass, 0.02, spin, 0.02)}</robot>'
    ramp = Ground(normal=(math.sin(slope), 0.0, math.cos(slope)), friction=0.0)
    start = tuple(radius * x for x in ramp.normal)
    wheels = [Wheel("disk", radius)]
    options = {"position": start, "feet": {"disk": radius}, "wheels": wheels}
    with build(Robot(write_urdf(text), fixed_base=False, **options), ground=ramp) as simulation:
        simulation.step(1000)
        speed = float(np.linalg.norm(simulation.body_velocities(["disk"])[0, :3]))
        (carried,) = simulation.contacts()["force"]
        assert simulation.velocities()[4] == pytest.approx(speed / radius)
    wanted = 9.81 * math.sin(slope) / (1 + spin / (mass * radius**2))
    assert speed == pytest.approx(wanted, rel=1e-9)
    np.testing.assert_allclose(carried, mass * 9.81 * math.cos(slope) * np.array(ramp.normal))


@pytest.mark.parametrize("lateral", [True, False])
def test_wheels_roll_forward_and_slide_aside_only_as_omni_wheels(cart, lateral):
    with build(cart(lateral)) as simulation:
        start = simulation.snapshot()
        simulation.apply_wrench(Wrench("base", force=(20.0, 0.0, 0.0)))
        simulation.step(500)
        speed = 0.5 * 20.0 / (6.0 + 2 * 0.003 / 0.1**2)  # the wheels' inertia counts twice
        assert simulation.velocities()[0] == pytest.approx(speed, rel=1e-6)
        simulation.restore(start)
        simulation.apply_wrench(Wrench("base", force=(0.0, 20.0, 0.0)))
        simulation.step(500)
        aside = simulation.positions()[1]
        assert abs(aside) < 1e-9 if lateral else aside > 0.1


def test_omni_wheels_have_no_friction_whatever_changes(cart):
    found = []
    for friction in (None, 0.8):
        with build(cart(lateral=False)) as simulation:
            if friction is not None:
                for side in ("left", "right"):
                    simulation.set_body(f"{side} wheel", BodySettings(friction=friction))
            simulation.step(10)
            simulation.apply_wrench(Wrench("base", (0, 5, 0)))
            simulation.step(200)
            found.append(simulation.positions())
    np.testing.assert_array_equal(*found)


def test_a_lifted_cart_is_free_and_one_on_a_belt_is_carried(cart):
    with build(cart(position=(0.0, 0.0, 1.0))) as simulation:
        v = np.zeros(8)
        v[1] = 0.5
        simulation.set_state(simulation.positions(), v)
        simulation.step(100)
        assert simulation.velocities()[1] == pytest.approx(0.5)
        assert simulation.velocities()[6:] == pytest.approx([0.0, 0.0], abs=1e-12)
    with build(cart()) as simulation:
        simulation.set_body("ground", BodySettings(surface_velocity=(0.2, 0.02, 0.0)))
        simulation.step(10)
        state = simulation.snapshot()
        for wheel in ("left wheel", "right wheel"):
            twist = simulation.body_velocities([wheel])[0]
            touching = twist[:3] + np.cross(twist[3:], [0.0, 0.0, -0.1])
            np.testing.assert_allclose(touching, [0.2, 0.02, 0.0], atol=1e-5)
        simulation.step(50)
        after = simulation.positions()
        simulation.restore(state)
        simulation.step(50)
        np.testing.assert_array_equal(simulation.positions(), after)


def test_a_cart_tows_another_one(cart):
    """Both are solved as one: the wheels of a cart, and what holds it to the other one."""
    carts = [cart(name="front"), cart(name="back", position=(-1.0, 0.0, 0.1))]
    hook = Connect("front/base", "back/base", (-0.5, 0.0, 0.0), (0.5, 0.0, 0.0))
    world = World(carts, ground=Ground(), attachments=[hook])
    with plugins.resolve("backend", "pinocchio").build(world) as simulation:
        simulation.apply_wrench(Wrench("front/base", force=(20.0, 0.0, 0.0)))
        simulation.step(500)
        speeds = simulation.body_velocities(["front/base", "back/base"])[:, 0]
    np.testing.assert_allclose(speeds, 0.25 * 20.0 / 6.6, rtol=1e-6)


@pytest.mark.parametrize("name", ["dart", "mujoco"])
def test_engines_that_cannot_say_so(cart, name):
    with pytest.raises(FeatureNotSupportedError, match='"rolling"'):
        plugins.resolve("backend", name).build(World([cart()], ground=Ground()))


def test_forces_of_wheels_are_not_known(cart):
    with build(cart()) as simulation:
        simulation.step()
        with pytest.raises(SimulationError, match="wheels that roll without slip"):
            simulation.joint_wrenches()
        with pytest.raises(SimulationError, match="no derivatives while there are wheels"):
            simulation.step_with_derivatives()


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"radius": 0.0}, ConfigError, "radius .* must be positive"),
        ({"axis": (0.0, 0.0, 0.0)}, ConfigError, "axis must not be 0"),
        ({"link": 3}, ConfigError, "not the name of a link"),
        ({"link": "left weel"}, ModelError, 'wheels names "left weel", which is not a link'),
    ],
)
def test_wrong_wheels_are_errors(cart, options, error, said):
    with pytest.raises(error, match=said):
        read_robot(cart(wheels=[Wheel(**{"link": "left wheel", "radius": 0.1, **options})]))


def test_wheels_need_different_links_and_a_plane(cart):
    with pytest.raises(ModelError, match="different links, but are left wheel, left wheel"):
        read_robot(cart(wheels=2 * [Wheel("left wheel", 0.1)]))
    for ground in (None, HeightField(heights=np.zeros((2, 2)), spacing=(1.0, 1.0))):
        with pytest.raises(ModelError, match="roll without slip on a plane"):
            build(cart(), ground=ground)
    with pytest.raises(ConfigError, match=r"'left wheel' is not a Wheel"):
        cart(wheels=["left wheel"])
