"""Wrenches, hooks, actuators, and springs; velocities of bodies, and derivatives."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from physx_sim import Ground, JointSettings, Robot, Sphere, World, Wrench
from physx_sim.errors import SimulationError

BALL = Sphere(name="ball", radius=0.1, mass=2.0)
CALM = {"gravity": (0.0, 0.0, 0.0)}


def drawn(backend, bar, steps=1, command=0.0, **settings):
    """Return a bar without gravity whose joint has settings, after some steps."""
    robot = bar(joints={"hinge": JointSettings(**settings)})
    simulation = backend.build(World([robot], **CALM))
    simulation.set_commands([command])
    simulation.step(steps)
    return simulation


# Wrenches ---------------------------------------------------------------------------------------


def test_a_permanent_wrench_acts_until_it_is_removed(backend):
    with backend.build(World(objects=[BALL], **CALM)) as simulation:
        number = simulation.apply_wrench(Wrench("ball", force=(4.0, 0, 0)))
        simulation.step(100)
        np.testing.assert_allclose(simulation.velocities()[0], 0.2, rtol=1e-12)
        simulation.remove_wrench(number)
        simulation.step(100)
        np.testing.assert_allclose(simulation.velocities()[0], 0.2, rtol=1e-12)
        with pytest.raises(SimulationError, match="No wrench has the number"):
            simulation.remove_wrench(number)


@pytest.mark.parametrize("frame", ["world", "body"])
def test_a_force_follows_the_world_or_the_body(backend, frame):
    with backend.build(World(objects=[BALL], **CALM)) as simulation:
        q = simulation.positions()
        q[3:] = 0, 0, np.sqrt(0.5), np.sqrt(0.5)  # its x axis points along y
        simulation.set_state(q, [0, 0, 0, 0, 0, 1.0])
        simulation.apply_wrench(Wrench("ball", force=(2.0, 0, 0), frame=frame))
        simulation.step(1000)
        speed = simulation.body_velocities(["ball"])[0, :3]
        expected = [1, 0, 0] if frame == "world" else [np.cos(1) - 1, np.sin(1), 0]
        np.testing.assert_allclose(speed, expected, atol=1e-3)


def test_a_force_off_the_center_rotates(backend):
    with backend.build(World(objects=[BALL], **CALM)) as simulation:
        wrench = Wrench("ball", force=(0, 2.0, 0), torque=(0, 0, 0.5), point=(0.1, 0, 0))
        simulation.apply_wrench(wrench)
        simulation.step()
        inertia = 0.4 * 2 * 0.1**2
        expected = [0, 1e-3, 0, 0, 0, 1e-3 * 0.7 / inertia]
        np.testing.assert_allclose(simulation.velocities(), expected, atol=1e-7)


def test_a_profile_is_linear_between_its_points_and_ends(backend):
    times = np.array([0.0, 0.01, 0.03])
    force = np.array([[0, 0, 0], [10.0, 0, 0], [-10.0, 0, 0]])
    with backend.build(World(objects=[BALL], **CALM)) as simulation:
        simulation.step(7)
        simulation.apply_wrench(Wrench("ball", force=force, times=times))
        speeds = []
        for _ in range(40):
            simulation.step()
            speeds.append(simulation.velocities()[0])
        at = np.interp(1e-3 * np.arange(40), times, force[:, 0], right=0.0)
        np.testing.assert_allclose(speeds, 1e-3 / 2 * np.cumsum(at), atol=1e-12)


def test_wrenches_are_part_of_a_snapshot(backend):
    with backend.build(World(objects=[BALL])) as simulation:
        simulation.apply_wrench(Wrench("ball", force=(4.0, 0, 0), duration=0.05))
        kept = simulation.apply_wrench(Wrench("ball", torque=(0, 0.02, 0)))
        simulation.step(20)
        state = copy.deepcopy(simulation.snapshot())
        simulation.step(60)
        expected = simulation.positions()
        simulation.remove_wrench(kept)
        simulation.restore(state)
        simulation.step(60)
        np.testing.assert_array_equal(simulation.positions(), expected)
        simulation.remove_wrench(kept)


def test_wrenches_on_immobile_bodies_are_rejected(backend, bar):
    robot = bar()
    with backend.build(World([robot], ground=Ground())) as simulation:
        for name, words in (
            ("base", "cannot move"),
            ("ground", "cannot move"),
            ("nobody", "no link"),
        ):
            with pytest.raises(SimulationError, match=words):
                simulation.apply_wrench(Wrench(name))
        with pytest.raises(SimulationError, match="is not a Wrench"):
            simulation.apply_wrench("bar")


# Hooks ------------------------------------------------------------------------------------------


def test_hooks_are_called_at_their_frames(backend, bar):
    frames = {1: [], 4: []}
    with backend.build(World([bar()])) as simulation:
        simulation.step(3)
        hooks = {every: (lambda s, every=every: frames[every].append(s.frame)) for every in (1, 4)}
        for every, hook in hooks.items():
            simulation.add_hook(hook, every)
        simulation.step(6)
        simulation.remove_hook(hooks[1])
        simulation.step(6)
        assert frames == {1: [3, 4, 5, 6, 7, 8], 4: [4, 8, 12]}
        with pytest.raises(SimulationError, match="is not a hook"):
            simulation.remove_hook(hooks[1])


def test_a_hook_may_set_commands_but_not_step_or_close(backend, bar):
    with backend.build(World([bar()], **CALM)) as simulation:
        simulation.add_hook(lambda s: s.set_torques([0.6 if s.frame % 2 else -0.6]))
        simulation.step(3)
        np.testing.assert_allclose(simulation.velocities(), [-1e-3], rtol=1e-8)
        simulation.add_hook(lambda s: s.step())
        with pytest.raises(SimulationError, match="hook must not call step"):
            simulation.step()
    simulation = backend.build(World([bar()]))
    simulation.add_hook(lambda s: s.close())
    with pytest.raises(SimulationError, match="closed"):
        simulation.step(2)


def test_stepping_with_a_hook_is_stepping(backend, example):
    world = World([Robot(example("solo_description/robots/solo12.urdf"), fixed_base=False)])
    with backend.build(world) as one, backend.build(world) as other:
        one.add_hook(lambda s: None)
        for simulation in (one, other):
            simulation.set_torques(np.linspace(-1, 1, 12))
            simulation.step(60)
        for _ in range(40):
            other.step()
        one.step(40)
        np.testing.assert_array_equal(one.positions(), other.positions())
        np.testing.assert_array_equal(one.velocities(), other.velocities())


# Actuators and springs --------------------------------------------------------------------------


def test_a_velocity_joint_reaches_its_velocity_at_once(backend, bar):
    with drawn(backend, bar, 1, 0.7, mode="velocity") as simulation:
        np.testing.assert_allclose(simulation.velocities(), [0.7], rtol=1e-6)
        simulation.step(100)
        np.testing.assert_allclose(simulation.positions(), [0.7 * 0.101], rtol=1e-6)


def test_a_servo_reaches_its_velocity_as_fast_as_its_torque_allows(backend, bar):
    limit = '<limit lower="-9" upper="9" velocity="5" effort="6"/>'
    robot = bar(limit, "revolute", joints={"hinge": JointSettings(mode="servo")})
    with backend.build(World([robot], **CALM)) as simulation:
        simulation.set_commands([0.8])
        simulation.step(40)
        np.testing.assert_allclose(simulation.velocities(), [0.4], rtol=1e-6)
        simulation.step(100)
        np.testing.assert_allclose(simulation.velocities(), [0.8], rtol=1e-6)
        simulation.set_commands([50.0])
        np.testing.assert_array_equal(simulation.snapshot().commands, [5.0])


def test_a_position_joint_reaches_its_target_and_holds_against_gravity(backend, bar):
    limit = '<limit lower="-2" upper="2" velocity="3" effort="60"/>'
    settings = {"hinge": JointSettings(mode="position", gain=30)}
    robot = bar(limit, "revolute", joints=settings)
    with backend.build(World([robot])) as simulation:
        assert simulation.layout.modes == ("position",)
        simulation.set_commands([1.2])
        speeds = []
        for _ in range(100):
            simulation.step(10)
            speeds.append(simulation.velocities()[0])
        np.testing.assert_allclose(simulation.positions(), [1.2], atol=1e-6)
        assert max(speeds) < 3 + 1e-6
        simulation.set_commands([9.0])
        np.testing.assert_array_equal(simulation.snapshot().commands, [2.0])


@pytest.mark.parametrize("mode", ["servo", "velocity", "position"])
def test_engines_agree_on_actuators(dart, pinocchio, bar, mode):
    limit = '<limit lower="-2" upper="2" velocity="3" effort="8"/>'
    robot = bar(limit, "revolute", joints={"hinge": JointSettings(mode=mode, friction=0.3)})
    with dart.build(World([robot])) as one, pinocchio.build(World([robot])) as other:
        for simulation in (one, other):
            simulation.set_commands([0.9])
            simulation.step(500)
        np.testing.assert_allclose(one.positions(), other.positions(), atol=1e-6)


def test_set_torques_names_the_joints_that_it_cannot_drive(backend, bar):
    simulation = drawn(backend, bar, mode="servo")
    with simulation, pytest.raises(SimulationError, match=r"hinge\. Use set_commands"):
        simulation.set_torques([1.0])


def test_springs_are_implicit_and_stable(backend, bar):
    settings = {"stiffness": 1e5, "rest": 0.1, "damping": 10.0}
    with drawn(backend, bar, 3000, **settings) as simulation:
        np.testing.assert_allclose(simulation.positions(), [0.1], atol=1e-6)
    with drawn(backend, bar, 1, stiffness=60.0, rest=0.1, damping=3.0) as simulation:
        v = 1e-3 * 60 * 0.1 / (0.6 + 3e-3 + 60e-6)
        np.testing.assert_allclose(simulation.velocities(), [v], rtol=1e-7)
        a = simulation.forward_dynamics([0.3], [0.5], [0.2])
        np.testing.assert_allclose(a, [(0.2 - 60 * 0.2 - 3 * 0.5) / 0.6], rtol=1e-7)
        np.testing.assert_allclose(simulation.inverse_dynamics([0.3], [0.5], a), [0.2], atol=1e-9)


@pytest.mark.filterwarnings("ignore:.*armature")
def test_armature_is_inertia(backend, bar):
    robot = bar(joints={"hinge": JointSettings(armature=0.4)})
    with backend.build(World([robot], **CALM)) as simulation:
        np.testing.assert_allclose(simulation.mass_matrix([0.0]), [[1.0]], rtol=1e-8)
        simulation.set_torques([2.0])
        simulation.step(10)
        np.testing.assert_allclose(simulation.velocities(), [0.02], rtol=1e-8)


# Bodies -----------------------------------------------------------------------------------------


def test_body_velocities_are_those_of_the_jacobian_and_of_motion(backend, example):
    world = World([Robot(example("solo_description/robots/solo12.urdf"), fixed_base=False)])
    rng = np.random.default_rng(0)
    with backend.build(world) as simulation:
        q, v = simulation.positions(), rng.normal(size=18)
        q[7:] = rng.normal(size=12)
        foot = simulation.layout.bodies[-1]
        found = simulation.body_velocities([foot], q, v)
        np.testing.assert_allclose(simulation.jacobian(foot, q) @ v, found[0], atol=1e-12)
        simulation.set_state(q, v)
        np.testing.assert_allclose(simulation.body_velocities([foot]), found, atol=1e-12)
        before = simulation.body_poses([foot], q)[0, :3]
        h = 1e-6
        simulation.set_state(q, v)
        moved = q.copy()
        moved[7:] += h * v[6:]
        moved[:3] += h * v[:3]  # its base is not turned
        half = 0.5 * h * v[3:6]
        moved[3:7] = [*half, 1.0] / np.linalg.norm([*half, 1.0])
        after = simulation.body_poses([foot], moved)[0, :3]
        np.testing.assert_allclose((after - before) / h, found[0, :3], atol=1e-4)


def test_derivatives_are_those_of_finite_differences(backend, bar, example):
    joints = {"hinge": JointSettings(stiffness=3.0, damping=0.4, friction=0.1)}
    robots = [bar(joints=joints), Robot(example("panda_description/urdf/panda.urdf"), "panda")]
    with backend.build(World(robots)) as simulation:
        rng, n = np.random.default_rng(0), 10
        q, v, tau = simulation.positions(), rng.normal(size=n), rng.normal(size=n)
        found = simulation.forward_dynamics_derivatives(q, v, tau)
        point = [q, v, tau]
        for which in range(3):
            for column in (0, 1, 6):
                ahead, back = ([x.copy() for x in point] for _ in range(2))
                ahead[which][column] += 1e-6
                back[which][column] -= 1e-6
                change = simulation.forward_dynamics(*ahead) - simulation.forward_dynamics(*back)
                scale = np.abs(found[which][:, column]).max() + 1
                error = np.abs(change / 2e-6 - found[which][:, column]).max() / scale
                assert error < 1e-5
        for matrix in found:
            assert matrix.flags.c_contiguous
            assert matrix.shape == (n, n)
