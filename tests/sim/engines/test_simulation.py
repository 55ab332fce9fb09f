"""A single engine: physics with known solutions, and errors."""

from __future__ import annotations

import copy
import gc
import pickle
import subprocess
import sys

import numpy as np
import pytest

from physx_core import plugins
from physx_dart.environments.double_pendulum import URDF
from physx_sim import Ground, Robot, World
from physx_sim.errors import SimulationError

pytestmark = pytest.mark.processes


def test_both_plugins_are_found_without_importing_an_engine():
    code = (
        "import sys; from physx_core import plugins\n"
        "for name in ('dart', 'pinocchio'):\n"
        "    assert set(plugins.load(name).components) == {'backend', 'environment'}\n"
        "assert 'dartpy' not in sys.modules and 'pinocchio' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_free_fall_follows_semi_implicit_euler(backend, brick):
    with backend.build(brick) as simulation:
        q, v = simulation.positions(), simulation.velocities()
        # The frame's origin falls as the center of mass does while nothing turns.
        q[:3] = 1.0, 2.0, 30.0
        simulation.set_state(q, v)
        simulation.step(1000)
        fallen = 9.81 * 1e-6 * 1000 * 1001 / 2
        assert simulation.frame == 1000
        assert simulation.time == 1.0
        np.testing.assert_allclose(simulation.positions()[:3], [1, 2, 30 - fallen], atol=1e-9)
        np.testing.assert_allclose(simulation.velocities()[:3], [0, 0, -9.81], atol=1e-9)


def test_gravity_of_the_world_is_used(backend, brick):
    world = World(brick.robots, gravity=(1.0, 0.0, 0.0))
    with backend.build(world) as simulation:
        simulation.step()
        np.testing.assert_allclose(simulation.velocities()[:3], [1e-3, 0, 0], atol=1e-15)


def test_a_pendulum_conserves_its_energy(backend, bar):
    with backend.build(World([bar()], period=1e-4)) as simulation:
        simulation.set_state([1.0], [0.0])
        worst, weight = 0.0, 2 * 9.81 * 0.5
        for _ in range(200):
            simulation.step(100)
            (angle,), (rate,) = simulation.positions(), simulation.velocities()
            energy = 0.5 * 0.6 * rate**2 - weight * np.cos(angle)
            worst = max(worst, abs(energy + weight * np.cos(1.0)))
        assert worst / weight < 2e-4


def test_damping_is_implicit(backend, bar):
    robot = bar('<dynamics damping="3"/>')
    with backend.build(World([robot], gravity=(0, 0, 0))) as simulation:
        simulation.set_state([0.0], [1.0])
        simulation.step(100)
        expected = (1 + 3 * 1e-3 / 0.6) ** -100
        np.testing.assert_allclose(simulation.velocities(), [expected], rtol=1e-8)


def test_coulomb_friction_stops_and_holds(backend, bar):
    robot = bar('<dynamics friction="6"/>')
    with backend.build(World([robot], gravity=(0, 0, 0))) as simulation:
        simulation.set_state([0.0], [1.0])
        simulation.step(50)  # 6 N m slow 0.6 kg m² down by 10 rad/s²
        np.testing.assert_allclose(simulation.velocities(), [0.5], rtol=1e-8)
        simulation.step(100)
        stopped = simulation.positions()
        simulation.set_torques([5.9])
        simulation.step(500)
        np.testing.assert_allclose(simulation.positions(), stopped, atol=1e-8)
        np.testing.assert_allclose(simulation.velocities(), [0.0], atol=1e-8)
        simulation.set_torques([6.6])
        simulation.step(100)
        np.testing.assert_allclose(simulation.velocities(), [0.1], rtol=1e-6)


def test_position_and_velocity_limits_stop_the_joint(backend, bar):
    robot = bar('<limit lower="-0.3" upper="0.5" velocity="0.8" effort="50"/>', "revolute")
    with backend.build(World([robot])) as simulation:
        simulation.set_torques([50.0])
        simulation.step(200)
        np.testing.assert_allclose(simulation.velocities(), [0.8], rtol=1e-8)
        simulation.step(1000)
        np.testing.assert_allclose(simulation.positions(), [0.5], atol=1e-9)
        np.testing.assert_allclose(simulation.velocities(), [0.0], atol=1e-8)
        simulation.set_torques([-50.0])
        simulation.step(2000)
        np.testing.assert_allclose(simulation.positions(), [-0.3], atol=1e-9)


def test_a_joint_outside_its_limits_returns(backend, bar):
    robot = bar('<limit lower="-0.3" upper="0.5" velocity="1" effort="50"/>', "revolute")
    with backend.build(World([robot])) as simulation:
        simulation.set_state([0.505], [0.0])
        simulation.step()
        np.testing.assert_allclose(simulation.positions(), [0.5], atol=1e-8)


def test_torques_are_clipped_at_the_effort_limit(backend, bar):
    limit = '<limit lower="0" upper="0" velocity="0" effort="4"/>'
    with backend.build(World([bar(limit, "revolute")], gravity=(0, 0, 0))) as simulation:
        assert simulation.layout.max_torque.tolist() == [4.0]
        assert simulation.layout.max_velocity.tolist() == [np.inf]
        assert simulation.layout.upper.tolist() == [np.inf]
        simulation.set_torques([-100.0])
        simulation.step(60)
        np.testing.assert_allclose(simulation.velocities(), [-4 / 0.6 * 0.06], rtol=1e-8)
        np.testing.assert_array_equal(simulation.snapshot().commands, [-4.0])


def test_torques_are_held_until_changed(backend, bar):
    with backend.build(World([bar()], gravity=(0, 0, 0))) as simulation:
        simulation.set_torques([0.6])
        simulation.step(3)
        simulation.step(2)
        np.testing.assert_allclose(simulation.velocities(), [0.005], rtol=1e-8)


def test_a_continuous_joint_is_one_unwrapped_angle(backend, bar):
    with backend.build(World([bar()], gravity=(0, 0, 0))) as simulation:
        assert simulation.layout.nq == simulation.layout.nv == 1
        simulation.set_state([3.0], [10.0])
        simulation.step(1000)
        np.testing.assert_allclose(simulation.positions(), [13.0], rtol=1e-9)


def test_twist_of_a_floating_base_is_in_its_own_frame(backend, brick):
    quarter = np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)])  # turned by 90 degrees about z
    with backend.build(World(brick.robots, gravity=(0, 0, 0))) as simulation:
        simulation.set_state([*np.zeros(3), *quarter], [1.0, 0, 0, 0, 0, 0])
        np.testing.assert_allclose(simulation.velocities(), [1, 0, 0, 0, 0, 0], atol=1e-15)
        simulation.step(1000)
        np.testing.assert_allclose(simulation.positions(), [0, 1, 0, *quarter], atol=1e-9)


def test_rotation_of_a_floating_base_is_about_its_own_axes(backend, brick):
    quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # its y axis points along z
    with backend.build(World(brick.robots, gravity=(0, 0, 0))) as simulation:
        simulation.set_state([*np.zeros(3), *quarter], [0, 0, 0, 0, 0.5, 0])
        simulation.step()
        turned = np.array([0, 0, np.sin(0.25e-3), np.cos(0.25e-3)])
        x, y, z, w = turned
        matrix = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
        np.testing.assert_allclose(simulation.positions()[3:], matrix @ quarter, atol=1e-7)


def test_a_base_force_in_its_own_frame_accelerates_it(backend, brick):
    with backend.build(World(brick.robots, gravity=(0, 0, 0))) as simulation:
        q = np.array([0, 0, 0, 0.5, -0.5, 0.5, 0.5])
        force = np.array([3.0, -1.0, 2.0])
        # A force through the center of mass turns nothing; 2 kg, center at (0.1, 0, 0.05).
        wrench = np.concatenate([force, np.cross([0.1, 0, 0.05], force)])
        a = simulation.forward_dynamics(q, np.zeros(6), wrench)
        np.testing.assert_allclose(a, [1.5, -0.5, 1.0, 0, 0, 0], atol=1e-12)
        np.testing.assert_allclose(simulation.inverse_dynamics(q, np.zeros(6), a), wrench)


def test_dynamics_and_poses_leave_the_running_state_alone(backend, example):
    world = World([Robot(example("solo_description/robots/solo12.urdf"), fixed_base=False)])
    rng = np.random.default_rng(0)
    with backend.build(world) as simulation, backend.build(world) as untouched:
        q = simulation.positions() + np.array([*[0] * 7, *rng.normal(size=12)])
        for one in (simulation, untouched):
            one.set_state(q, np.linspace(-1, 1, 18))
            one.set_torques(np.linspace(-0.2, 0.2, 12))
        for _ in range(5):
            v, x = rng.normal(size=18), rng.normal(size=18)
            simulation.forward_dynamics(q, v, x)
            simulation.inverse_dynamics(q, v, x)
            simulation.body_poses(positions=q)
            simulation.body_poses()
            simulation.step(3)
            untouched.step(3)
        np.testing.assert_array_equal(simulation.positions(), untouched.positions())
        np.testing.assert_array_equal(simulation.velocities(), untouched.velocities())


def test_poses_of_links_behind_fixed_joints(backend, bar):
    with backend.build(World([bar()])) as simulation:
        assert simulation.layout.bodies == ("base", "bar", "tip")
        simulation.set_state([np.pi / 2], [0.0])
        half = np.sqrt(0.5)
        expected = [[-1, 0, 0, 0, half, 0, half], [0, 0, 0, 0, 0, 0, 1]]
        np.testing.assert_allclose(simulation.body_poses(["tip", "base"]), expected, atol=1e-12)
        at_zero = simulation.body_poses(["tip"], positions=[0.0])
        np.testing.assert_allclose(at_zero, [[0, 0, -1, 0, 0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("fixed_base", [True, False])
def test_restore_continues_bit_for_bit(backend, example, fixed_base):
    world = World([Robot(example("solo_description/robots/solo12.urdf"), fixed_base=fixed_base)])
    rng = np.random.default_rng(1)
    with backend.build(world) as simulation, backend.build(world) as other:
        simulation.set_torques(rng.normal(size=12) * 0.3)
        simulation.step(137)
        state = copy.deepcopy(simulation.snapshot())
        assert len(pickle.dumps(state)) < 10_000

        def go_on(one):
            one.step(100)
            return np.concatenate([one.positions(), one.velocities(), [one.frame]])

        first = go_on(simulation)
        simulation.set_torques(np.ones(12))
        simulation.step(5)
        for one in (simulation, other):
            one.restore(state)
            np.testing.assert_array_equal(go_on(one), first)
        assert first[-1] == 237


def test_a_snapshot_can_be_restored_in_the_other_engine(dart, pinocchio, brick):
    with dart.build(brick) as one, pinocchio.build(brick) as other:
        one.set_state([1, 2, 3, 0.5, 0.5, -0.5, 0.5], np.arange(6.0))
        one.step(10)
        other.restore(one.snapshot())
        assert other.frame == 10
        np.testing.assert_allclose(other.positions(), one.positions(), atol=1e-14)
        one.restore(other.snapshot())
        np.testing.assert_allclose(other.velocities(), one.velocities(), atol=1e-13)


def test_two_robots_are_one_state(backend, bar, brick):
    robots = [bar(name="left"), Robot(brick.robots[0].urdf, "box", fixed_base=False)]
    world = World([*robots, bar(name="right")])
    with backend.build(world) as simulation, backend.build(World([bar()])) as alone:
        layout = simulation.layout
        assert layout.joints == ("left/hinge", "right/hinge")
        assert layout.bodies[3:] == ("box/brick", "right/base", "right/bar", "right/tip")
        assert (layout.nq, layout.nv) == (9, 8)
        assert layout.position_index == {"left/hinge": 0, "right/hinge": 8}
        assert layout.velocity_index == {"left/hinge": 0, "right/hinge": 7}
        q, v = simulation.positions(), simulation.velocities()
        q[8], v[7] = 0.7, 0.2
        simulation.set_state(q, v)
        alone.set_state([0.7], [0.2])
        simulation.set_torques([0.0, 1.5])
        alone.set_torques([1.5])
        for one in (simulation, alone):
            one.step(500)
        assert simulation.positions()[0] == 0.0
        assert simulation.positions()[8] == alone.positions()[0]
        tip = simulation.body_poses(["right/tip"])
        np.testing.assert_array_equal(tip, alone.body_poses(["tip"]))
        tau = np.arange(8.0)
        q, v = simulation.positions(), simulation.velocities()
        a = simulation.forward_dynamics(q, v, tau)
        np.testing.assert_allclose(simulation.inverse_dynamics(q, v, a), tau, atol=1e-12)


def test_neutral_configuration_is_zero_or_the_nearest_limit(backend, bar):
    robot = bar('<limit lower="0.2" upper="0.5" velocity="1" effort="5"/>', "revolute")
    with backend.build(World([robot])) as simulation:
        assert simulation.positions().tolist() == [0.2]
        assert simulation.velocities().tolist() == [0.0]


def test_out_is_filled(backend):
    with backend.build(World([Robot(URDF)])) as simulation:
        simulation.set_state([1.0, 2.0], [3.0, 4.0])
        out = np.zeros(2)
        assert simulation.positions(out) is out
        assert out.tolist() == [1.0, 2.0]
        assert simulation.velocities(out).tolist() == [3.0, 4.0]
        with pytest.raises(SimulationError, match=r"\(3,\).*\(2,\)"):
            simulation.positions(np.zeros(3))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda s: s.set_torques([1.0]), r"torques have the shape \(1,\) but need \(2,\)"),
        (lambda s: s.set_torques([1.0, np.nan]), "torques must be finite"),
        (lambda s: s.set_torques(["a", "b"]), "torques are not numbers"),
        (lambda s: s.set_state([0.0], [0.0, 0.0]), "positions have the shape"),
        (lambda s: s.set_state([0.0, 0.0], [0.0, np.inf]), "velocities must be finite"),
        (lambda s: s.forward_dynamics(np.zeros(2), np.zeros(2), np.zeros(3)), "torques have"),
        (lambda s: s.inverse_dynamics(np.zeros(2), np.zeros(2), [np.nan] * 2), "accelerations"),
        (lambda s: s.body_poses(["uper"]), 'no link "uper". Did you mean "upper"'),
        (lambda s: s.step(-1), "negative"),
    ],
)
def test_invalid_arguments_are_named(backend, call, words):
    simulation = backend.build(World([Robot(URDF)]))
    with simulation, pytest.raises(SimulationError, match=words):
        call(simulation)


def test_an_invalid_quaternion_is_named(backend, brick):
    simulation = backend.build(brick)
    with simulation, pytest.raises(SimulationError, match="quaternion.*length 0, not 1"):
        simulation.set_state(np.zeros(7), np.zeros(6))


def test_a_state_that_explodes_is_an_error(backend, bar, capfd):
    with backend.build(World([bar()], gravity=(0, 0, 0))) as simulation:
        simulation.set_torques([1e12])
        with pytest.raises(SimulationError, match="no longer finite"):
            simulation.step(1000)


@pytest.mark.parametrize(
    "call",
    [
        lambda s: s.step(),
        lambda s: s.frame,
        lambda s: s.time,
        lambda s: s.positions(),
        lambda s: s.velocities(),
        lambda s: s.set_torques(np.zeros(2)),
        lambda s: s.set_state(np.zeros(2), np.zeros(2)),
        lambda s: s.snapshot(),
        lambda s: s.restore(None),
        lambda s: s.body_poses(),
        lambda s: s.forward_dynamics(np.zeros(2), np.zeros(2), np.zeros(2)),
        lambda s: s.inverse_dynamics(np.zeros(2), np.zeros(2), np.zeros(2)),
    ],
)
def test_a_closed_simulation_says_so(backend, call):
    simulation = backend.build(World([Robot(URDF)]))
    simulation.close()
    simulation.close()
    with pytest.raises(SimulationError, match="closed"):
        call(simulation)


@pytest.mark.parametrize("name", ["dart", "pinocchio", "mujoco"])
def test_steps_leave_nothing_to_the_garbage_collector(name):
    """Objects that refer to each other wait for it, which takes a tenth of the time of a step."""
    ant = Robot("ant", fixed_base=False, position=(0, 0, 0.5))
    with plugins.resolve("backend", name).build(World([ant], ground=Ground())) as simulation:
        simulation.step(500)
        assert len(simulation.contacts())
        gc.collect()
        gc.disable()
        try:
            simulation.step(20)
            assert gc.collect() == 0
        finally:
            gc.enable()


def test_backends_are_resolved_by_name():
    for name in ("dart", "pinocchio"):
        assert plugins.resolve("backend", name) is not None
        with plugins.resolve("backend", f"{name}/{name}").build(World([Robot(URDF)])) as one:
            assert {"forward_dynamics", "limits", "exact_restore"} <= one.features
