"""Motions with a known solution, for each integrator."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from physx_core import plugins
from physx_dart.environments.double_pendulum import URDF
from physx_sim import Imu, JointSettings, Robot, Sensors, Sphere, World, Wrench
from physx_sim.errors import FeatureNotSupportedError, SimulationError

SLIDERS = """
<robot name="sliders">
  <link name="base"/>
  <joint name="first" type="prismatic">
    <parent link="base"/><child link="one"/><axis xyz="1 0 0"/><limit effort="0" velocity="0"/>
  </joint>
  <link name="one"><inertial><mass value="1.5"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="second" type="prismatic">
    <parent link="one"/><child link="two"/><axis xyz="1 0 0"/><limit effort="0" velocity="0"/>
  </joint>
  <link name="two"><inertial><mass value="0.7"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>
"""


def energy_error(backend, robot, period, integrator, seconds=10):
    world = World([robot], period=period, integrator=integrator)
    with backend.build(world) as simulation:
        simulation.set_state([1.0], [0.0])
        worst, weight = 0.0, 2 * 9.81 * 0.5 + 1e-9 * 9.81  # with the tip of 1e-9 kg
        for _ in range(200):
            simulation.step(round(seconds / 200 / period))
            (angle,), (rate,) = simulation.positions(), simulation.velocities()
            energy = 0.5 * (0.6 + 1e-9) * rate**2 - weight * np.cos(angle)
            worst = max(worst, abs(energy + weight * np.cos(1.0)))
    return worst / weight


def test_the_energy_error_of_a_pendulum_is_proportional_to_the_period(backend, bar):
    errors = [energy_error(backend, bar(), period, "euler") for period in (1e-3, 5e-4)]
    assert errors[0] < 1e-3
    np.testing.assert_allclose(errors[0] / errors[1], 2.0, rtol=0.05)


@pytest.mark.slow
def test_rk4_keeps_the_energy_of_a_pendulum(backend, bar):
    assert energy_error(backend, bar(), 1e-3, "rk4") < 1e-11


@pytest.mark.slow
def test_rk4_keeps_the_energy_of_a_double_pendulum(backend):
    robot = Robot(URDF, joints={name: JointSettings(damping=0.0) for name in ("shoulder", "elbow")})
    with backend.build(World([robot], integrator="rk4")) as simulation:
        simulation.set_state([0.5, -0.3], [0.0, 0.0])
        energies = []
        for _ in range(100):
            simulation.step(100)
            q, v = simulation.positions(), simulation.velocities()
            heights = simulation.body_poses(["upper", "lower"])[:, 2] - 0.25 * np.cos(q.cumsum())
            energies.append(0.5 * v @ simulation.mass_matrix(q) @ v + 9.81 * heights.sum())
        assert max(energies) - min(energies) < 1e-9
        assert simulation.time == 10.0


@pytest.mark.slow
def test_rk4_follows_the_solution_of_the_pendulum(backend, bar):
    """The reference is the same equation, solved with steps ten times smaller."""
    with backend.build(World([bar()], integrator="rk4")) as simulation:
        simulation.set_state([0.1], [0.0])
        x = np.array([0.1, 0.0])

        def rate(x):
            return np.array([x[1], -2 * 9.81 * 0.5 / 0.6 * np.sin(x[0])])

        for _ in range(20):
            simulation.step(100)
            for _ in range(1000):
                k1 = rate(x)
                k2 = rate(x + 5e-5 * k1)
                k3 = rate(x + 5e-5 * k2)
                x = x + 1e-4 / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + 1e-4 * k3))
            state = np.concatenate([simulation.positions(), simulation.velocities()])
            np.testing.assert_allclose(state, x, atol=1e-7)


def test_rk4_of_a_spring_with_a_rotor_follows_its_solution(pinocchio, write_urdf):
    joints = {
        "first": JointSettings(stiffness=40, rest=0.2, armature=0.9),
        "second": JointSettings(stiffness=25, damping=0.8, armature=0.3),
    }
    robot = Robot(write_urdf(SLIDERS), joints=joints)
    world = World([robot], gravity=(0, 0, 0), integrator="rk4")
    with pinocchio.build(world) as simulation:
        mass = simulation.mass_matrix(np.zeros(2))
        np.testing.assert_allclose(mass, [[2.2 + 0.9, 0.7], [0.7, 0.7 + 0.3]], rtol=1e-8)
        inverse, k, d = np.linalg.inv(mass), np.diag([40.0, 25.0]), np.diag([0.0, 0.8])
        system = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ k, -inverse @ d]])
        values, vectors = np.linalg.eig(system)
        rest, x0 = np.array([0.2, 0, 0, 0]), np.array([0.5, -0.1, 0.3, 0.0])
        parts = np.linalg.solve(vectors, (x0 - rest).astype(complex))
        simulation.set_state(x0[:2], x0[2:])
        for i in range(1, 21):
            simulation.step(100)
            exact = rest + (vectors @ (np.exp(values * 0.1 * i) * parts)).real
            state = np.concatenate([simulation.positions(), simulation.velocities()])
            np.testing.assert_allclose(state, exact, atol=1e-7)


@pytest.mark.slow
def test_rk4_follows_the_solution_under_constant_forces(backend, write_urdf):
    """Two masses on springs; a controller sets their forces every 10 ms."""
    joints = {"first": JointSettings(stiffness=40), "second": JointSettings(stiffness=25)}
    world = World([Robot(write_urdf(SLIDERS), joints=joints)], gravity=(0, 0, 0), integrator="rk4")
    with backend.build(world) as simulation:
        inverse = np.linalg.inv([[2.2, 0.7], [0.7, 0.7]])
        system = np.block(
            [[np.zeros((2, 2)), np.eye(2)], [-inverse @ np.diag([40.0, 25.0]), np.zeros((2, 2))]]
        )
        values, vectors = np.linalg.eig(system)
        over = (vectors * np.exp(0.01 * values) @ np.linalg.inv(vectors)).real
        x = np.array([0.3, -0.1, 0.0, 0.2])
        simulation.set_state(x[:2], x[2:])
        for _ in range(200):
            q, v = simulation.positions(), simulation.velocities()
            forces = -5.0 * q - 2.0 * v
            simulation.set_torques(forces)
            simulation.step(10)
            rest = np.array([*(forces / [40.0, 25.0]), 0.0, 0.0])
            x = rest + over @ (x - rest)
            state = np.concatenate([simulation.positions(), simulation.velocities()])
            np.testing.assert_allclose(state, x, atol=1e-7)


def test_a_pulse_has_the_right_edges_and_size(backend, write_urdf):
    world = World([Robot(write_urdf(SLIDERS))], gravity=(0, 0, 0))
    with backend.build(world) as simulation:
        simulation.step(100)
        simulation.apply_wrench(Wrench("two", force=(3.0, 0, 0), duration=0.05))
        speeds = []
        for _ in range(70):
            simulation.step()
            speeds.append(simulation.velocities().sum())
        along = 1e-3 * 3.0 / 0.7 * np.minimum(np.arange(1, 71), 50)
        np.testing.assert_allclose(speeds, along, rtol=1e-7)
        assert simulation.snapshot().wrenches == ()


@pytest.mark.parametrize(("integrator", "accuracy"), [("euler", 5e-3), ("rk4", 1e-5)])
def test_a_spin_without_torques_keeps_momentum_and_energy(backend, brick, integrator, accuracy):
    world = World(brick.robots, gravity=(0, 0, 0), integrator=integrator)
    with backend.build(world) as simulation:
        q, v = simulation.positions(), np.array([0.3, -0.2, 0.1, 1.0, 5.0, -2.0])

        def measure():
            q, v = simulation.positions(), simulation.velocities()
            momentum = simulation.mass_matrix(q) @ v
            poses = simulation.body_poses(["brick"])[0]
            x, y, z, w = poses[3:]
            turn = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
                ]
            )
            linear = turn @ momentum[:3]
            angular = turn @ momentum[3:] + np.cross(q[:3], linear)
            return np.concatenate([linear, angular]), 0.5 * v @ simulation.mass_matrix(q) @ v

        simulation.set_state(q, v)
        before, energy = measure()
        simulation.step(1000)
        after, later = measure()
        assert np.linalg.norm(after - before) / np.linalg.norm(before) < accuracy
        assert abs(later / energy - 1) < accuracy


def test_accelerations_are_those_of_the_last_step(backend, example):
    world = World([Robot(example("panda_description/urdf/panda.urdf"))])
    with backend.build(world) as simulation:
        assert not simulation.accelerations().any()
        simulation.set_torques(np.linspace(-3, 3, 9))
        simulation.step(40)
        before = simulation.velocities()
        simulation.step()
        gained = (simulation.velocities() - before) / 1e-3
        np.testing.assert_allclose(simulation.accelerations(), gained, atol=1e-9)
        simulation.restore(simulation.snapshot())
        np.testing.assert_allclose(simulation.accelerations(), gained, atol=1e-9)
        simulation.set_state(simulation.positions(), simulation.velocities())
        assert not simulation.accelerations().any()


def test_accelerations_of_a_floating_base_agree(dart, pinocchio, brick):
    with dart.build(brick) as one, pinocchio.build(brick) as other:
        for simulation in (one, other):
            simulation.set_state(simulation.positions(), [1, 2, 3, 0.5, -0.4, 0.3])
            simulation.step(20)
        np.testing.assert_allclose(one.accelerations(), other.accelerations(), atol=1e-10)
        q, v = other.positions(), other.velocities()
        free = other.forward_dynamics(q, v, np.zeros(6))
        np.testing.assert_allclose(other.accelerations(), free, atol=0.02)


@pytest.mark.parametrize(
    ("engine", "change", "words"),
    [
        ("dart", {"friction": 1.0}, 'joint_friction in rk4, of the joint "hinge"'),
        ("pinocchio", {"friction": 1.0}, 'joint_friction in rk4, of the joint "hinge"'),
        ("pinocchio", {"mode": "servo"}, "actuators in rk4"),
    ],
)
def test_rk4_is_rejected_where_it_is_not_valid(engine, change, words, bar):
    robot = dataclasses.replace(bar(), joints={"hinge": JointSettings(**change)})
    with pytest.raises(FeatureNotSupportedError, match=words):
        plugins.resolve("backend", engine).build(World([robot], integrator="rk4"))


def test_rk4_rejects_limits(pinocchio, bar):
    robot = bar('<limit lower="-0.3" upper="0.5" velocity="0.8" effort="50"/>', "revolute")
    with pytest.raises(FeatureNotSupportedError, match="limits in rk4"):
        pinocchio.build(World([robot], integrator="rk4"))


@pytest.mark.slow
def test_engines_agree_in_rk4_under_wrenches(dart, pinocchio, brick):
    world, ends = dataclasses.replace(brick, integrator="rk4"), []
    for backend in (dart, pinocchio):
        with backend.build(world) as simulation:
            body = simulation.layout.bodies[-1]
            simulation.set_state(simulation.positions(), np.linspace(-2, 3, 6))
            simulation.apply_wrench(Wrench(body, (3, -2, 1), (0.1, 0.2, 0.3), frame="body"))
            simulation.apply_wrench(Wrench(body, (1, 2, 2), point=(0.1, 0, 0), frame="body"))
            simulation.step(300)
            before = simulation.velocities()
            simulation.step()
            gained = (simulation.velocities() - before) / 1e-3
            ends.append([*simulation.positions(), *before, *gained])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)


def test_gravity_changes_while_it_runs(engine):
    world = World(objects=[Sphere(name="ball", radius=0.1, position=(0, 0, 5))])
    imu = Imu(name="imu", body="ball")
    moon = (0.0, 0.5, -1.6)
    with engine.build(world) as simulation, engine.build(world) as other:
        simulation.step(100)
        simulation.set_gravity(moon)
        np.testing.assert_array_equal(simulation.gravity, moon)
        before = simulation.body_velocities(["ball"])[0, :3]
        simulation.step(100)
        gained = simulation.body_velocities(["ball"])[0, :3] - before
        np.testing.assert_allclose(gained, np.array(moon) * 0.1, atol=1e-9)
        q, zero = simulation.positions(), np.zeros(6)
        np.testing.assert_allclose(simulation.forward_dynamics(q, zero, zero)[:3], moon, atol=1e-9)
        sensors = Sensors(simulation, world, [imu])
        sensors.update(simulation)
        np.testing.assert_allclose(sensors["imu"]["acceleration"], 0, atol=1e-9)
        other.restore(simulation.snapshot())
        for each in (simulation, other):
            each.step(50)
        np.testing.assert_array_equal(other.positions(), simulation.positions())
        np.testing.assert_array_equal(other.gravity, moon)
        with pytest.raises(SimulationError, match="gravity"):
            simulation.set_gravity((0, 0))
