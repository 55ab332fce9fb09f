"""Motors on the engines, against analytic solutions and exact recurrences."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from physx_sim import JointSettings, Motor, Motors, Robot, World, with_rotors

INERTIA = 0.6 + 1e-9
PERIOD = 1e-3


def floating(robot, **options):
    return World([robot], gravity=(0, 0, 0), period=PERIOD, **options)


def test_the_velocity_approaches_its_bound_exponentially(backend, bar):
    """Below the slope the acceleration is constant; on it the gap to the bound decays."""
    world = floating(bar())
    with backend.build(world) as simulation:
        motor = Motor(joint="hinge", max_torque=40, max_velocity=15, slope=8.0)
        motors = Motors(simulation, world, [motor]).attach(simulation)
        motors.set_commands([100.0])
        velocities = []
        for _ in range(3000):
            simulation.step()
            velocities.append(simulation.velocities()[0])
        v = np.array(velocities)
        assert (v < 15).all() or ((v <= 15).all() and v.max() == 15)
        np.testing.assert_allclose(np.diff(v[:100]) / PERIOD, 40 / INERTIA, rtol=1e-7)
        assert abs(v[-1] - 15) < 1e-7 and abs(v[-1] - v[-2]) / PERIOD < 1e-7
        gap = 15 - v[(v > 10.5) & (v < 14.999)]
        decay = -np.log1p(-PERIOD * 8.0 / INERTIA)  # of one step of semi-implicit Euler
        slope = np.polyfit(np.arange(len(gap)), np.log(gap), 1)[0]
        assert abs(slope / -decay - 1) < 1e-5
        motors.set_commands([-100.0])
        simulation.step()
        assert abs((simulation.velocities()[0] - v[-1]) / PERIOD + 40 / INERTIA) < 1e-6


@pytest.mark.slow
def test_viscous_friction_and_reduction_give_the_steady_speed(backend, bar):
    world = floating(bar())
    with backend.build(world) as simulation:
        motor = Motor(joint="hinge", viscous=(0.02, 0.05), dry=(0.3, 0.1), reduction=10)
        motors = Motors(simulation, world, [motor]).attach(simulation)
        for command, shaft in ((1.0, (1.0 - 0.3) / 0.02), (-1.0, -(1.0 - 0.1) / 0.05)):
            motors.set_commands([command])
            simulation.step(5500)
            np.testing.assert_allclose(simulation.velocities(), shaft / 10, rtol=1e-7)
            np.testing.assert_allclose(motors.torques, 0, atol=1e-7)


@pytest.mark.filterwarnings("ignore:.*armature")
def test_rigid_rotors_are_part_of_the_mass(backend, bar):
    world = floating(bar(joints={"hinge": JointSettings(damping=0.5)}))
    motor = Motor(joint="hinge", inertia=2e-3, reduction=10)
    geared = with_rotors(world, [motor])
    assert geared.robots[0].joints["hinge"] == JointSettings(damping=0.5, armature=2e-3 * 100)
    with backend.build(with_rotors(floating(bar()), [motor])) as simulation:
        motors = Motors(simulation, geared, [motor]).attach(simulation)
        motors.set_commands([0.4])
        simulation.step(500)
        exact = 0.5 * 0.4 * 10 / (INERTIA + 0.2)
        np.testing.assert_allclose(simulation.velocities(), exact, rtol=1e-7)


def elastic(**options):
    given = {"stiffness": 400.0, "damping": 0.7, "inertia": 2e-3, "reduction": 10.0}
    return Motor(joint="hinge", **{**given, **options})


def test_a_rotor_behind_an_elastic_gear_follows_the_two_mass_system(backend, bar):
    """Against the exact recurrence of both masses, and the solution of the equations."""
    world = floating(bar())
    with backend.build(world) as simulation:
        motors = Motors(simulation, world, [elastic()]).attach(simulation)
        motors.set_commands([0.3])
        masses, k, d, drive = np.array([0.2, INERTIA]), 400.0, 0.7, np.array([3.0, 0.0])
        x = np.zeros(4)
        pull = np.array([[-1.0, 1.0], [1.0, -1.0]])
        a = np.vstack([k * pull.T, d * pull.T]).T / masses[:, None]
        for _ in range(10):
            simulation.step(100)
            for _ in range(100):
                x[2:] += PERIOD * (a @ x + drive / masses)
                x[:2] += PERIOD * x[2:]
            state = motors.snapshot()
            q, v = simulation.positions()[0], simulation.velocities()[0]
            found = [state.rotor_positions[0], q, state.rotor_velocities[0], v]
            np.testing.assert_allclose(found, x, atol=1e-9)
        mass, total, time = 0.2 * INERTIA / (0.2 + INERTIA), 0.2 + INERTIA, 1.0
        root = np.sqrt(complex((d / 2 / mass) ** 2 - k / mass))
        rates = -d / 2 / mass + root, -d / 2 / mass - root
        parts = [rates[1] * np.exp(rates[0] * time), rates[0] * np.exp(rates[1] * time)]
        twist = 3.0 / 0.2 * mass / k * (1 + (parts[0] - parts[1]) / (rates[0] - rates[1]))
        middle = 0.5 * 3.0 / total * time**2
        np.testing.assert_allclose(0.2 / total * x[0] + INERTIA / total * x[1], middle, rtol=2e-3)
        np.testing.assert_allclose(x[0] - x[1], twist.real, rtol=2e-2)


def test_within_the_backlash_the_rotor_moves_alone(backend, bar):
    world = floating(bar())
    with backend.build(world) as simulation:
        gear = elastic(backlash=0.1, stiffness=3000.0, damping=20.0)
        motors = Motors(simulation, world, [gear]).attach(simulation)
        motors.set_commands([0.2])
        alone = 0
        while simulation.step() or not simulation.velocities().any():
            alone += 1
            assert simulation.positions()[0] == 0
        step = PERIOD * 2.0 / 0.2
        reached = step * PERIOD * np.arange(1000).cumsum()  # of semi-implicit Euler
        assert alone == np.searchsorted(reached, 0.05, side="right")
        simulation.step(3000)
        state, v = motors.snapshot(), simulation.velocities()[0]
        rotor = state.rotor_velocities[0]
        time = simulation.frame * PERIOD
        np.testing.assert_allclose(0.2 * rotor + INERTIA * v, 2.0 * time, rtol=1e-9)
        np.testing.assert_allclose([rotor, v], 2.0 * time / (0.2 + INERTIA), rtol=1e-7)
        ahead = state.rotor_positions[0] - simulation.positions()[0]
        gear_torque = 2.0 * INERTIA / (0.2 + INERTIA)
        np.testing.assert_allclose(ahead, 0.05 + gear_torque / 3000, rtol=1e-7)
        np.testing.assert_allclose(motors.torques, gear_torque, rtol=1e-7)


def test_dry_friction_of_an_elastic_gear_sticks(backend, bar):
    """A hanging bar on a gear holds as long as its weight is less than the friction."""
    world = World([bar()], period=PERIOD)
    with backend.build(world) as simulation:
        gear = elastic(dry=0.5, stiffness=2000.0, damping=20.0)
        simulation.set_state([0.2], [0.0])
        motors = Motors(simulation, world, [gear]).attach(simulation)
        simulation.step(2000)
        assert motors.snapshot().rotor_positions[0] == 0.2
        assert not motors.snapshot().rotor_velocities[0]
        bent = 0.2 - simulation.positions()[0]
        weight = 2 * 9.81 * 0.5 * np.sin(simulation.positions()[0])
        np.testing.assert_allclose(2000 * bent, weight, rtol=1e-5)


def test_motors_adopt_commands_at_their_own_periods(backend, example):
    robot = Robot(example("panda_description/urdf/panda.urdf"))
    world = World([robot], period=PERIOD)
    with backend.build(world) as simulation:
        joints = simulation.layout.joints
        motors = Motors(
            simulation,
            world,
            [Motor(joint=joints[2], period=4e-3, max_torque=5), Motor(joint=joints[0])],
        ).attach(simulation)
        simulation.step(3)
        motors.set_commands([9.0, 2.0])
        simulation.step()
        assert motors.torques.tolist() == [0, 2]
        simulation.step()
        assert motors.torques.tolist() == [5, 2]
        held = simulation.snapshot().commands
        assert held[[2, 0]].tolist() == [5, 2] and np.count_nonzero(held) == 2
        others = np.ones(len(joints))
        motors.set_others(others)
        motors.set_commands([0.0, 0.0])
        simulation.step(4)
        assert simulation.snapshot().commands[:4].tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize("copied", [False, True])
def test_a_restored_motor_continues_bit_for_bit(backend, bar, copied):
    world = World([bar()], period=PERIOD)
    motor = elastic(backlash=0.02, dry=0.01, max_velocity=30, slope=0.3, period=5e-3)
    with backend.build(world) as simulation:
        motors = Motors(simulation, world, [motor]).attach(simulation)
        motors.set_commands([0.8])
        simulation.step(123)
        state, own = simulation.snapshot(), motors.snapshot()
        if copied:
            simulation.remove_hook(motors)
            motors = pickle.loads(pickle.dumps(motors)).attach(simulation)  # noqa: S301
        ends = []
        for _ in range(2):
            motors.set_commands([-0.5])
            simulation.step(200)
            ends.append([*simulation.positions(), *simulation.velocities(), *motors.torques])
            simulation.restore(state)
            motors.restore(pickle.loads(pickle.dumps(own)))  # noqa: S301
        assert ends[0] == ends[1]
