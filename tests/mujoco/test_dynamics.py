"""MuJoCo's kinematics and dynamics are those of DART and Pinocchio, on every robot they load."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from physx_core import PhysxError
from physx_sim import Box, JointSettings, Robot, World, Wrench
from physx_sim.engines import named_robots, read_robot

pytest.importorskip("mujoco")

ROBOTS = sorted(named_robots())


def world_of(name, **options):
    """Return a world with a robot, which floats if its root link has a mass."""
    model = read_robot(Robot(name))
    floats = model.bodies[0].mass > 1e-6
    return World([Robot(name, fixed_base=not floats, collisions="none", **options)])


def random_state(simulation, rng):
    """Return a random state, with accelerations."""
    layout = simulation.layout
    q = simulation.positions()
    for part in layout.parts.values():
        begin = part.positions.start
        if part.floating:
            turn = rng.normal(size=4)
            q[begin : begin + 3] = rng.uniform(-1, 1, 3)
            q[begin + 3 : begin + 7] = turn / np.linalg.norm(turn)
    q[list(layout.position_index.values())] = rng.uniform(-1, 1, len(layout.joints))
    return q, *rng.uniform(-1, 1, (2, layout.nv))


def check_close(found, expected, bound):
    assert np.abs(found - expected).max() <= bound * np.abs(expected).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_accelerations_agree_with_both_engines(backend, dart, pinocchio, name):
    try:
        world = world_of(name)
    except PhysxError:
        with pytest.raises(PhysxError):
            backend.build(World([Robot(name)]))
        return
    with backend.build(world) as ours, dart.build(world) as one, pinocchio.build(world) as two:
        assert ours.layout.joints == one.layout.joints == two.layout.joints
        rng = np.random.default_rng(0)
        for _ in range(5):
            q, v, tau = random_state(ours, rng)
            a = ours.forward_dynamics(q, v, tau)
            for other in (one, two):
                check_close(a, other.forward_dynamics(q, v, tau), 1e-9)


@pytest.mark.parametrize("name", ["ant", "panda/panda", "talos_data/talos_reduced"])
def test_everything_else_agrees_with_pinocchio(backend, pinocchio, name):
    if name not in ROBOTS:
        pytest.skip("example-robot-data is not installed")
    joints = [joint.name for joint in read_robot(Robot(name)).joints]
    resistance = JointSettings(damping=0.3, friction=0.1, stiffness=2.0, rest=0.1, armature=0.05)
    pose = {"position": (1.0, 2.0, 3.0), "orientation": (0.5, 0.5, 0.5, 0.5)}
    robot = world_of(name, joints={joints[0]: resistance}, **pose).robots[0]
    brick = Box(name="brick", size=(0.1, 0.2, 0.3), mass=2.0, position=(0.0, 0.0, 9.0))
    wall = Box(name="wall", size=(1.0, 1.0, 1.0), static=True, position=(9.0, 0.0, 0.0))
    world = World([robot], objects=[brick, wall], contacts="none", gravity=(0.3, -0.2, -9.0))
    rng = np.random.default_rng(1)
    with backend.build(world) as ours, pinocchio.build(world) as other:
        np.testing.assert_allclose(ours.positions(), other.positions(), atol=1e-15)
        link = ours.layout.bodies[-2]
        for _ in range(3):
            q, v, a = random_state(ours, rng)
            for call in (
                lambda s, q=q, v=v, a=a: s.forward_dynamics(q, v, a),
                lambda s, q=q, v=v, a=a: s.inverse_dynamics(q, v, a),
                lambda s, q=q: s.mass_matrix(q),
                lambda s, q=q: s.jacobian(link, q, (0.1, -0.2, 0.3)),
                lambda s, q=q: s.jacobian("brick", q),
                lambda s, q=q: s.body_poses(s.layout.names, q),
                lambda s, q=q, v=v: s.body_velocities(s.layout.names, q, v),
                lambda s, q=q, v=v, a=a: s.forward_dynamics_batch(*(x[None] for x in (q, v, a))),
            ):
                check_close(call(ours), call(other), 1e-11)
            ours.set_state(q, v)
            other.restore(ours.snapshot())
            check_close(other.positions(), ours.positions(), 1e-15)
            check_close(ours.body_motions(), other.body_motions(), 1e-11)
            check_close(ours.joint_wrenches(), other.joint_wrenches(), 1e-11)


def test_reactions_and_motions_agree_in_a_tree_without_free_bodies(backend, pinocchio):
    world = World([Robot("double_pendulum")])
    with backend.build(world) as ours, pinocchio.build(world) as other:
        layout = ours.layout
        for simulation in (ours, other):
            simulation.set_state([0.4, -0.7], [1.0, 2.0])
            simulation.set_torques([0.5, -0.5])
            wrench = Wrench(layout.bodies[-1], (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (0.1, 0.0, 0.2))
            simulation.apply_wrench(wrench)
            simulation.step(100)
        for call in ("positions", "velocities", "accelerations", "body_motions", "joint_wrenches"):
            check_close(getattr(ours, call)(), getattr(other, call)(), 1e-9)


def test_moments_of_inertia_that_no_body_has_are_kept(backend, pinocchio, tmp_path):
    inertia = 'ixx="1" iyy="0.1" izz="0.2" ixy="0.05" ixz="-0.02" iyz="0.01"'
    text = (
        '<robot name="odd"><link name="base"/><link name="bar"><inertial>'
        f'<origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/><mass value="2"/><inertia {inertia}/>'
        '</inertial></link><joint name="hinge" type="revolute"><parent link="base"/>'
        '<child link="bar"/><origin xyz="1 2 3" rpy="0.3 0.2 0.1"/><axis xyz="1 2 2"/>'
        '<limit lower="-1" upper="1" effort="10" velocity="10"/></joint></robot>'
    )
    moments = [float(ElementTree.fromstring(f"<i {inertia}/>").get(n)) for n in ("ixx", "iyy")]
    assert moments[0] > sum(moments[1:]) + 0.2  # violates the triangle inequality
    path = tmp_path / "odd.urdf"
    path.write_text(text, encoding="utf-8")
    world = World([Robot(path)])
    with backend.build(world) as ours, pinocchio.build(world) as other:
        for q in (-0.7, 0.0, 0.9):
            state = [q], [0.3], [1.1]
            check_close(ours.forward_dynamics(*state), other.forward_dynamics(*state), 1e-13)
