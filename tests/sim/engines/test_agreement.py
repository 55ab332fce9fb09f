"""DART and Pinocchio give the same numbers."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import plugins
from physx_dart.environments.double_pendulum import URDF
from physx_sim import JointSettings, Mimic, Robot, World

FREE = JointSettings(mimic=Mimic(""))

ROBOTS = {
    "panda": ("panda_description/urdf/panda.urdf", True),
    "floating panda": ("panda_description/urdf/panda.urdf", False),
    "solo12": ("solo_description/robots/solo12.urdf", False),
    "a1": ("a1_description/urdf/a1.urdf", False),  # links without inertia
    "z1": ("z1_description/urdf/z1.urdf", True),  # root link `world`, joint friction
    "allegro": ("allegro_hand_description/urdf/allegro_left_hand.urdf", True),  # a tree
    "ur5": ("ur_description/urdf/ur5_robot.urdf", True),
    "go2": ("go2_description/urdf/go2.urdf", False),
    "talos": ("talos_data/robots/talos_reduced.urdf", False),
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", False),  # links without inertia
    "double pendulum": (None, True),
}


@pytest.fixture(params=ROBOTS)
def pair(request, dart, pinocchio, example):
    name, fixed_base = ROBOTS[request.param]
    # DART's limits and friction do not know what couples joints.
    joints = {"panda_finger_joint2": FREE} if "panda" in request.param else {}
    robot = Robot(URDF if name is None else example(name), fixed_base=fixed_base, joints=joints)
    with dart.build(World([robot])) as one, pinocchio.build(World([robot])) as other:
        yield one, other


def random_state(layout, rng):
    n = len(layout.joints)
    lower, upper = np.maximum(layout.lower, -2), np.minimum(layout.upper, 2)
    q = np.concatenate([rng.normal(size=layout.nq - n), rng.uniform(lower, upper)])
    if layout.nq > n:
        q[3:7] /= np.linalg.norm(q[3:7])
        q[3:7] *= np.sign(q[6])
    return q, rng.normal(size=layout.nv)


def apart(one, other):
    return np.abs(one - other).max() / max(np.abs(one).max(), np.abs(other).max())


def test_layouts_are_equal(pair):
    one, other = (simulation.layout for simulation in pair)
    assert one.joints == other.joints
    assert one.bodies == other.bodies
    assert one.position_index == other.position_index
    assert (one.nq, one.nv) == (other.nq, other.nv)


def test_dynamics_agree_and_are_inverse_to_each_other(pair):
    one, other = pair
    rng = np.random.default_rng(0)
    for _ in range(20):
        q, v = random_state(one.layout, rng)
        tau = 5 * rng.normal(size=one.layout.nv)
        a = one.forward_dynamics(q, v, tau)
        assert apart(a, other.forward_dynamics(q, v, tau)) < 1e-12
        x = rng.normal(size=one.layout.nv)
        assert apart(one.inverse_dynamics(q, v, x), other.inverse_dynamics(q, v, x)) < 1e-12
        for simulation in pair:
            assert apart(simulation.inverse_dynamics(q, v, a), tau) < 1e-11


def test_states_and_poses_agree(pair):
    one, other = pair
    rng = np.random.default_rng(1)
    for _ in range(10):
        q, v = random_state(one.layout, rng)
        for simulation in pair:
            simulation.set_state(q, v)
            np.testing.assert_allclose(simulation.positions(), q, atol=1e-14)
            np.testing.assert_allclose(simulation.velocities(), v, atol=1e-14)
            poses = simulation.body_poses()
            np.testing.assert_allclose(poses, simulation.body_poses(positions=q), atol=1e-13)
        np.testing.assert_allclose(
            one.body_poses(positions=q), other.body_poses(positions=q), atol=1e-13
        )


def test_motions_agree_through_limits_and_friction(pair):
    one, other = pair
    rng = np.random.default_rng(2)
    q, v = random_state(one.layout, rng)
    n = len(one.layout.joints)
    v[-n:] = np.clip(v[-n:], -0.5 * one.layout.max_velocity, 0.5 * one.layout.max_velocity)
    tau = one.inverse_dynamics(q, v, rng.normal(size=len(v)))[-n:]
    for simulation in pair:
        simulation.set_state(q, v)
        simulation.set_torques(tau)
    for _ in range(10):
        for simulation in pair:
            simulation.step(20)
        np.testing.assert_allclose(one.positions(), other.positions(), atol=1e-8)


@pytest.mark.slow
def test_joints_pushed_into_their_limits_agree(dart, pinocchio, example):
    joints = {"panda_finger_joint2": FREE}
    world = World([Robot(example("panda_description/urdf/panda.urdf"), joints=joints)])
    with dart.build(world) as one, pinocchio.build(world) as other:
        middle = (one.layout.lower + one.layout.upper) / 2
        for simulation in (one, other):
            simulation.set_state(middle, np.zeros(9))
            simulation.set_torques(0.4 * one.layout.max_torque)
        for _ in range(20):
            for simulation in (one, other):
                simulation.step(100)
            np.testing.assert_allclose(one.positions(), other.positions(), atol=1e-7)
        at_limit = np.abs(one.positions() - one.layout.upper) < 1e-8
        assert at_limit.sum() >= 5
        assert (one.positions() < one.layout.upper + 1e-8).all()


def test_double_pendulums_agree_for_a_thousand_steps(dart, pinocchio):
    with dart.build(World([Robot(URDF)])) as one, pinocchio.build(World([Robot(URDF)])) as other:
        for simulation in (one, other):
            simulation.set_state([1.0, 0.5], [0.0, 0.0])
            simulation.step(1000)
        np.testing.assert_allclose(one.positions(), other.positions(), atol=1e-10)


def test_tumbling_quadrupeds_agree_for_a_second(dart, pinocchio, example):
    world = World([Robot(example("go2_description/urdf/go2.urdf"), fixed_base=False)])
    with dart.build(world) as one, pinocchio.build(world) as other:
        for simulation in (one, other):
            q = simulation.positions()
            q[7:] = np.tile([0.0, 0.9, -1.8], 4)
            simulation.set_state(q, [*np.zeros(3), 2.0, -3.0, 1.0, *np.full(12, 0.2)])
            simulation.step(1000)
        np.testing.assert_allclose(one.positions()[7:], other.positions()[7:], atol=1e-8)
        np.testing.assert_allclose(one.positions()[:7], other.positions()[:7], atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm", "double-pendulum"])
def test_environments_agree_over_a_thousand_steps(name, drive):
    one, other = (
        drive(plugins.resolve("environment", f"{engine}/{name}"), 100, episode_steps=60)
        for engine in ("dart", "pinocchio")
    )
    for left, right in zip(one, other, strict=True):
        assert left.keys() == right.keys()
        for field in left:
            np.testing.assert_allclose(left[field], right[field], atol=1e-9, rtol=1e-9)
