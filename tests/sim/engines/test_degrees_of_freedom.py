"""Robots with no, one, two and many joints, fixed and floating, in contact or not."""

from __future__ import annotations

import numpy as np
import pytest

from physx_sim import Box, Ground, HeightField, JointSettings, Robot, Sphere, Stairs, World, Wrench

pytestmark = pytest.mark.processes

LINK = """<link name="{name}"><inertial><origin xyz="0.1 0 -0.05"/><mass value="{mass}"/>
<inertia ixx="0.01" iyy="0.02" izz="0.015" ixy="0.001" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0.2 0 0"/><geometry>{shape}</geometry></collision></link>"""
JOINT = """<joint name="j{i}" type="{kind}"><origin xyz="0.4 0 0"/><parent link="{parent}"/>
<child link="l{i}"/><axis xyz="{axis}"/><limit lower="-1" upper="1" effort="5" velocity="5"/>
<dynamics damping="0.1"/></joint>"""
SHAPES = (
    '<box size="0.4 0.1 0.1"/>',
    '<sphere radius="0.1"/>',
    '<capsule radius="0.05" length="0.2"/>',
    '<cylinder radius="0.08" length="0.1"/>',
)
KINDS = {
    "no joint": (),
    "a hinge": ("revolute",),
    "a slide": ("prismatic",),
    "two joints": ("revolute", "prismatic"),
    "seven joints": ("revolute", "prismatic", *["revolute"] * 5),
}
CASES = [(kind, fixed) for kind in KINDS for fixed in (True, False) if KINDS[kind] or not fixed]


@pytest.fixture
def chain(write_urdf):
    """Write a chain of links with these kinds of joints, each link with a shape."""

    def write(kinds):
        parts = [LINK.format(name="base", mass=2.0, shape=SHAPES[0])]
        for i, kind in enumerate(kinds):
            parent, axis = f"l{i - 1}" if i else "base", f"{i % 2} {1 - i % 2} 0"
            shape = SHAPES[i % len(SHAPES)]
            parts.append(LINK.format(name=f"l{i}", mass=1 / (i + 1), shape=shape))
            parts.append(JOINT.format(i=i, kind=kind, parent=parent, axis=axis))
        return write_urdf(f'<robot name="chain">{"".join(parts)}</robot>', "chain.urdf")

    return write


def things(name, robot, twin):
    """Return the options of a world in which a robot touches something, or nothing."""
    wall = Box(name="wall", size=(1.0, 1.0, 0.1), static=True, position=(0.3, 0.0, 0.0))
    ball = Sphere(name="ball", radius=0.1, mass=0.3, position=(0.3, 0.0, 0.3))
    return {
        "nothing": {"robots": [robot], "contacts": "none"},
        "ground": {"robots": [robot], "ground": Ground()},
        "stairs": {"robots": [robot], "ground": Stairs(rise=0.05, begin=0.2)},
        "heights": {"robots": [robot], "ground": HeightField(np.zeros((9, 9)), (1.0, 1.0))},
        "static object": {"robots": [robot], "objects": [wall]},
        "moving object": {"robots": [robot], "objects": [ball], "ground": Ground()},
        "only static contacts": {"robots": [robot], "objects": [ball, wall], "contacts": "static"},
        "robot": {"robots": [robot, twin]},
    }[name]


TOUCHED = ("nothing", "ground", "stairs", "heights", "static object", "moving object")
TOUCHED += ("only static contacts", "robot")


@pytest.mark.parametrize("touched", TOUCHED)
@pytest.mark.parametrize(("kind", "fixed"), CASES)
def test_every_feature_works(backend, chain, kind, fixed, touched):
    path, options = chain(KINDS[kind]), {"fixed_base": fixed, "self_collisions": True}
    robot = Robot(path, "a", position=(0.0, 0.0, 0.1), friction=0.5, **options)
    twin = Robot(path, "b", position=(0.05, 0.02, 0.199), **options)
    with backend.build(World(**things(touched, robot, twin))) as simulation:
        layout = simulation.layout
        nv, joints, bodies = layout.nv, len(layout.joints), len(layout.bodies)
        q, v, link = simulation.positions(), np.full(nv, 0.1), layout.bodies[len(KINDS[kind])]
        rows = [np.tile(values, (40, 1)) for values in (q, v, v, v)]
        simulation.set_commands(np.full(joints, 0.2))
        touches = 0
        for _ in range(15):
            simulation.step(10)
            touches += len(simulation.contacts())
        # What its own base or another welded one holds may not move toward anything.
        assert touches or touched in ("nothing", "robot") or kind == "a slide"
        assert simulation.accelerations().shape == simulation.velocities().shape == (nv,)
        assert simulation.mass_matrix(q).shape == (nv, nv)
        assert simulation.jacobian(link, q).shape == (6, nv)
        assert simulation.joint_wrenches().shape == (joints, 6)
        assert simulation.body_motions().shape == (bodies, 19)
        single = simulation.forward_dynamics(q, v, v)
        found = simulation.forward_dynamics_batch(*rows[:3])
        np.testing.assert_allclose(found, np.tile(single, (40, 1)), rtol=1e-9, atol=1e-9)
        found = simulation.inverse_dynamics(q, v, single)
        np.testing.assert_allclose(found, v, rtol=1e-9, atol=1e-9)
        derivatives = simulation.forward_dynamics_derivatives(q, v, v)
        assert [matrix.shape for matrix in derivatives] == [(nv, nv)] * 3
        np.testing.assert_allclose(
            derivatives[2] @ simulation.mass_matrix(q), np.eye(nv), atol=1e-8
        )
        assert simulation.forward_dynamics_gradients_batch(*rows).shape == (3, 40, nv)
        if KINDS[kind] or not fixed:
            simulation.apply_wrench(Wrench(link, (1.0, 0.0, 0.0)))
        simulation.step(3)
        state = simulation.snapshot()
        simulation.step(5)
        ended = simulation.positions()
        simulation.restore(state)
        simulation.step(5)
        np.testing.assert_allclose(simulation.positions(), ended, rtol=0, atol=1e-6)
        if "raycast" in simulation.features:
            simulation.raycast([[0.0, 0.0, 5.0]], [[0.0, 0.0, -5.0]])
        simulation.set_state(q, v)


@pytest.mark.parametrize("mode", ["servo", "velocity", "position"])
@pytest.mark.parametrize(("kind", "fixed"), [case for case in CASES if KINDS[case[0]]])
def test_every_mode_works_on_the_ground(backend, chain, kind, fixed, mode):
    settings = JointSettings(mode=mode, stiffness=1.0, friction=0.1)
    joints = {f"j{i}": settings for i in range(len(KINDS[kind]))}
    place = (0.0, 0.0, 0.12)
    robot = Robot(chain(KINDS[kind]), fixed_base=fixed, position=place, joints=joints)
    with backend.build(World([robot], ground=Ground())) as simulation:
        simulation.set_commands(np.full(len(joints), -0.05))  # against the ground
        simulation.step(100)
        assert np.isfinite(simulation.positions()).all()


@pytest.mark.parametrize(("kind", "fixed"), CASES)
def test_batches_in_several_processes_are_those_of_one(pinocchio, chain, kind, fixed):
    world = World([Robot(chain(KINDS[kind]), fixed_base=fixed)], contacts="none")
    with pinocchio.build(world) as simulation:
        q = np.tile(simulation.positions(), (40, 1))
        v, tau, weights = np.random.default_rng(0).normal(size=(3, 40, simulation.layout.nv))
        one, two = (
            (
                simulation.forward_dynamics_batch(q, v, tau, processes=processes),
                simulation.forward_dynamics_gradients_batch(
                    q, v, tau, weights, processes=processes
                ),
            )
            for processes in (1, 2)
        )
        for left, right in zip(one, two, strict=True):
            np.testing.assert_array_equal(left, right)


@pytest.mark.parametrize(("kind", "fixed"), CASES)
def test_engines_agree(dart, pinocchio, chain, kind, fixed):
    world = World([Robot(chain(KINDS[kind]), fixed_base=fixed)], contacts="none")
    rng = np.random.default_rng(0)
    with dart.build(world) as one, pinocchio.build(world) as two:
        for _ in range(5):
            q, (v, tau) = one.positions(), rng.uniform(-1, 1, (2, one.layout.nv))
            places = list(one.layout.position_index.values())
            q[places] = rng.uniform(-1, 1, len(places))
            a, b = (each.forward_dynamics(q, v, tau) for each in (one, two))
            np.testing.assert_allclose(b, a, rtol=1e-10, atol=1e-10)
        for simulation in (one, two):
            simulation.step(50)
        np.testing.assert_allclose(two.positions(), one.positions(), atol=1e-9)


DOOR = """<robot name="door"><link name="frame"/><link name="door">
<inertial><origin xyz="0.25 0 0"/><mass value="2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0.25 0 0"/><geometry><box size="0.5 0.02 1"/></geometry></collision></link>
<joint name="hinge" type="{kind}"><parent link="frame"/><child link="door"/><axis xyz="0 0 1"/>
<limit lower="-9" upper="9" effort="99" velocity="99"/></joint></robot>"""


def test_a_door_leans_against_a_stop(backend, write_urdf):
    """The force of the stop times its lever is the torque of the hinge."""
    robot = Robot(write_urdf(DOOR.format(kind="revolute")), position=(0.0, 0.0, 1.0))
    stop = Sphere(name="stop", radius=0.05, static=True, position=(0.4, 0.07, 1.0))
    with backend.build(World([robot], objects=[stop], ground=Ground())) as simulation:
        simulation.set_torques([3.0])
        simulation.step(1500)
        assert abs(simulation.velocities()[0]) < 1e-4
        contacts = simulation.contacts()
        torque = sum(np.cross(row["point"], row["force"])[2] for row in contacts)
        assert torque == pytest.approx(-3.0, rel=1e-3)


def test_a_slide_rests_on_the_ground(backend, write_urdf):
    """What the ground carries is the weight minus the force of the motor."""
    robot = Robot(write_urdf(DOOR.format(kind="prismatic")), position=(0.0, 0.0, 0.51))
    with backend.build(World([robot], ground=Ground())) as simulation:
        simulation.set_torques([5.0])
        simulation.step(1500)
        assert simulation.positions()[0] == pytest.approx(-0.01, abs=1e-3)
        forces = []
        for _ in range(20):
            simulation.step(5)
            forces.append(simulation.contacts()["force"].sum(axis=0)[2])
        assert np.mean(forces) == pytest.approx(2 * 9.81 - 5.0, rel=1e-2)


@pytest.mark.reported(
    "Genesis#1680",
    "PhysX#476",
    about="conveyors and moving ground",
)
def test_a_conveyor_carries_a_box(backend, write_urdf):
    """A slide with an imposed velocity, the usual model of a conveyor."""
    belt = DOOR.format(kind="prismatic").replace('axis xyz="0 0 1"', 'axis xyz="1 0 0"')
    belt = belt.replace('size="0.5 0.02 1"', 'size="4 1 0.1"')
    robot = Robot(write_urdf(belt), joints={"hinge": JointSettings(mode="velocity")})
    box = Box(name="box", size=(0.2, 0.2, 0.2), mass=1.0, position=(0.0, 0.0, 0.151))
    with backend.build(World([robot], objects=[box])) as simulation:
        simulation.set_commands([0.5])
        simulation.step(1000)
        assert simulation.body_velocities(["box"])[0, 0] == pytest.approx(0.5, abs=1e-3)
