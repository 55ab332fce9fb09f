"""Joints that follow others: the coupled motion, commands, snapshots, and wrong descriptions."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import plugins
from physx_core.errors import ConfigError
from physx_sim import JointSettings, Mimic, Robot, World
from physx_sim.engines import read_robot
from physx_sim.errors import FeatureNotSupportedError, ModelError

pytestmark = pytest.mark.processes

PERIOD, FORCE, STEPS = 1e-3, 2.0, 500
LINK = (
    '<link name="{}"><inertial><mass value="{}"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
FINGER = (
    '<joint name="{0}" type="prismatic"><parent link="palm"/><child link="{0} tip"/>'
    '<origin xyz="0 {1} 0"/><axis xyz="0 1 0"/><limit lower="-5" upper="5" effort="50"/>{2}</joint>'
)


@pytest.fixture
def gripper(write_urdf):
    """Write a gripper of fingers, each given by its name and its ``mimic`` element."""

    def make(*fingers, **options):
        parts = [LINK.format("palm", 10.0)]
        for place, (name, mimic) in enumerate(fingers):
            parts += [LINK.format(f"{name} tip", 1.0), FINGER.format(name, 0.1 * place, mimic)]
        return Robot(write_urdf(f'<robot name="gripper">{"".join(parts)}</robot>'), **options)

    return make


def follows(name, multiplier, offset=0.0):
    return f'<mimic joint="{name}" multiplier="{multiplier}" offset="{offset}"/>'


def build(engine, robot, **options):
    return engine.build(World([robot], period=PERIOD, gravity=(0, 0, 0), **options))


@pytest.mark.parametrize("multiplier", [-1.0, 0.5, -3.0])
@pytest.mark.parametrize("leader", ["left", "right"], ids=["leader first", "leader last"])
@pytest.mark.reported(
    "pinocchio#1290",
    "pinocchio#2131",
    "pinocchio#2753",
    "SAPIEN#236",
    "gz-physics#432",
    about="mimic joints are limp",
)
def test_a_leader_carries_its_follower(engine, gripper, multiplier, leader):
    follower = {"left": "right", "right": "left"}[leader]
    robot = gripper((leader, ""), (follower, follows(leader, multiplier, 0.05)))
    with build(engine, robot) as simulation:
        at = simulation.layout.position_index
        assert simulation.positions()[at[follower]] == pytest.approx(0.05)
        torques = np.zeros(2)
        torques[at[leader]] = FORCE
        simulation.set_torques(torques)
        simulation.step(STEPS)
        q = simulation.positions()
    fallen = 0.5 * STEPS * (STEPS + 1) * PERIOD**2
    assert q[at[leader]] == pytest.approx(FORCE / (1 + multiplier**2) * fallen, abs=1e-7)
    assert q[at[follower]] == pytest.approx(multiplier * q[at[leader]] + 0.05, abs=1e-7)


def test_a_gripper_in_the_air_moves_alike_on_all_engines(gripper):
    found = []
    robot = gripper(("left", ""), ("right", follows("left", -2.0)), fixed_base=False)
    for name in ("dart", "pinocchio", "mujoco"):
        with build(plugins.resolve("backend", name), robot) as simulation:
            simulation.set_torques([1.0, 0.0])
            simulation.step(STEPS)
            found.append(simulation.velocities())
    assert np.ptp(found, axis=0).max() < 1e-6


@pytest.mark.parametrize("mode", ["servo", "velocity", "position"])
def test_a_driven_leader_takes_its_follower_along(engine, gripper, mode):
    robot = gripper(
        ("left", ""), ("right", follows("left", -1.0)), joints={"left": JointSettings(mode=mode)}
    )
    with build(engine, robot) as simulation:
        simulation.set_commands([0.2, 0.0])
        simulation.step(1000)
        left, right = simulation.positions()
    assert left == pytest.approx(0.2, abs=0.02) and right == pytest.approx(-left, abs=3e-4)


@pytest.mark.parametrize("multiplier", [-1.0, 0.5, -2.0])
def test_the_velocity_limits_of_both_hold(engine, gripper, multiplier):
    fast = follows("left", multiplier)
    robot = gripper(("left", ""), ("right", fast), joints={})
    text = robot.urdf.read_text().replace('effort="50"', 'effort="50" velocity="0.5"')
    robot.urdf.write_text(text)
    with build(engine, robot) as simulation:
        simulation.set_torques([20.0, 0.0])
        simulation.step(200)
        left = 0.5 / max(1.0, abs(multiplier))
        np.testing.assert_allclose(simulation.velocities(), [left, multiplier * left], atol=2e-3)


def test_the_limits_and_resistance_of_a_follower_hold_its_leader(engine, gripper):
    robot = gripper(
        ("left", ""),
        ("right", follows("left", -1.0)),
        joints={"right": JointSettings(stiffness=100.0, damping=20.0)},
    )
    with build(engine, robot) as simulation:
        simulation.set_torques([10.0, 0.0])
        simulation.step(3000)
        np.testing.assert_allclose(simulation.positions(), [0.1, -0.1], atol=1e-4)


def test_followers_continue_from_a_snapshot(engine, gripper):
    robot = gripper(("left", ""), ("right", follows("left", -1.0)))
    with build(engine, robot) as simulation, build(engine, robot) as other:
        simulation.set_torques([FORCE, 0.0])
        simulation.step(100)
        other.restore(simulation.snapshot())
        for each in (simulation, other):
            each.step(100)
        np.testing.assert_array_equal(simulation.positions(), other.positions())


def test_a_chain_of_followers_follows_its_first_leader(gripper):
    robot = gripper(("a", ""), ("b", follows("a", 2.0, 0.1)), ("c", follows("b", -0.5, 0.2)))
    joints = {joint.name: joint for joint in read_robot(robot).joints}
    mimic = joints["c"].mimic
    assert (mimic.leader, mimic.multiplier, mimic.offset) == ("a", -1.0, pytest.approx(0.15))
    assert joints["a"].mimic is None and joints["c"].max_torque == 0.0


def test_settings_come_before_the_file(gripper):
    fingers = ("left", ""), ("right", follows("left", -1.0))
    free = gripper(*fingers, joints={"right": JointSettings(mimic=Mimic(""))})
    assert read_robot(free).followers == ()
    other = gripper(*fingers, joints={"right": JointSettings(mimic=Mimic("left", 2.0))})
    assert read_robot(other).followers == ((1, 0, Mimic("left", 2.0)),)


@pytest.mark.parametrize(
    ("mimic", "settings", "said"),
    [
        (follows("lift", 1), {}, 'follows "lift", which is not a movable joint'),
        (follows("right", 1), {}, "follow each other in a circle"),
        ('<mimic multiplier="2"/>', {}, "follows .* a joint without a name"),
        (
            follows("left", 1),
            {"right": JointSettings(mode="servo")},
            'takes no commands .* "servo"',
        ),
    ],
)
def test_wrong_leaders_are_errors(gripper, mimic, settings, said):
    with pytest.raises(ModelError, match=said):
        read_robot(gripper(("left", ""), ("right", mimic), joints=settings))


def test_a_multiplier_of_zero_is_an_error_or_a_warning(gripper):
    with pytest.raises(ConfigError, match="multiplier must not be 0"):
        Mimic("left", 0.0)
    robot = gripper(("left", ""), ("right", follows("left", 0)))
    assert "multiplier 0 move freely: right" in " ".join(read_robot(robot).warnings)


def test_runge_kutta_couples_nothing(engine, gripper):
    free = gripper(("left", ""), ("right", follows("left", 1.0)))
    with pytest.raises(FeatureNotSupportedError, match="in rk4"):
        build(engine, free, integrator="rk4")
