"""Rotors and servos on every engine: inertia in smooth motion, servos that leave their limits."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import plugins
from physx_sim import JointSettings, Robot, World

pytestmark = pytest.mark.processes

ROTORS = {"shoulder": 0.3, "elbow": 0.05}


def acrobot(fixed=True, **settings):
    joints = {name: JointSettings(armature=i, **settings) for name, i in ROTORS.items()}
    return Robot("double_pendulum", fixed_base=fixed, joints=joints)


@pytest.mark.filterwarnings("ignore:.*armature")
@pytest.mark.parametrize("fixed", [True, False], ids=["fixed", "floating"])
@pytest.mark.reported("mjlab#290", about="rotor inertia")
def test_rotors_move_alike_on_all_engines(fixed):
    found = []
    for name in ("dart", "pinocchio", "mujoco"):
        world = World([acrobot(fixed, damping=0.1, friction=0.0)], contacts="none")
        with plugins.resolve("backend", name).build(world) as simulation:
            n = simulation.layout.nq - 2
            q, v = simulation.positions(), np.zeros(simulation.layout.nv)
            q[n:], v[-2:] = (0.5, -0.7), (1.0, -2.0)
            simulation.set_state(q, v)
            simulation.set_torques([0.5, 0.2])
            simulation.step(1000)
            found.append([*simulation.positions(), *simulation.velocities()])
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    np.testing.assert_allclose(found[2], found[1], atol=1e-6)


@pytest.mark.filterwarnings("ignore:.*armature")
def test_dynamics_of_any_state_contain_rotors(engine):
    with engine.build(World([acrobot()])) as simulation:
        q, v, a = [0.4, 0.3], [1.0, -0.5], [2.0, 3.0]
        tau = simulation.inverse_dynamics(q, v, a)
        np.testing.assert_allclose(simulation.forward_dynamics(q, v, tau), a, atol=1e-10)
    still = Robot("double_pendulum")
    with engine.build(World([still])) as simulation:
        without = simulation.inverse_dynamics(q, v, a)
    np.testing.assert_allclose(tau - without, [0.3 * 2.0, 0.05 * 3.0], atol=1e-9)


def test_dart_says_that_its_impulses_do_not_know_rotors(dart):
    robot = Robot("double_pendulum", "rotor", joints={"elbow": JointSettings(armature=0.1)})
    with pytest.warns(UserWarning, match="limits and servos do not know the armature"):
        dart.build(World([robot])).close()


@pytest.mark.parametrize("mode", ["servo", "position"])
@pytest.mark.parametrize("load", [0.0, 5.0], ids=["unloaded", "loaded"])
@pytest.mark.reported(
    "dart#1583",
    "dart#1683",
    "gz-sim#1684",
    about="a servo that was pressed against its limit never leaves it",
)
def test_a_servo_leaves_its_limit(engine, bar, mode, load):
    limits = '<limit lower="-0.5" upper="0.5" effort="40" velocity="5"/>'
    robot = bar(limits, kind="revolute", joints={"hinge": JointSettings(mode=mode)})
    with engine.build(World([robot], gravity=(load, 0, 0))) as simulation:
        for side in (1.0, -1.0):
            simulation.set_commands([side])
            simulation.step(1200)
            assert simulation.positions()[0] == pytest.approx(0.5 * side, abs=1e-3)
        simulation.set_commands([0.3])
        simulation.step(200)
        assert simulation.positions()[0] > -0.45


def test_a_servo_that_is_too_weak_stays_at_its_limit(engine, bar):
    limits = '<limit lower="-0.5" upper="0.5" effort="1" velocity="5"/>'
    robot = bar(limits, kind="revolute", joints={"hinge": JointSettings(mode="servo")})
    with engine.build(World([robot], gravity=(50.0, 0, 0))) as simulation:
        simulation.set_commands([1.0])
        simulation.step(1500)
        reached = simulation.positions()[0]
        assert abs(reached) == pytest.approx(0.5, abs=1e-3)
        simulation.set_commands([-np.sign(reached)])
        simulation.step(500)
        assert simulation.positions()[0] == pytest.approx(reached, abs=1e-3)
