"""Motions of links and objects: poses, velocities, and accelerations of the last step."""

from __future__ import annotations

import numpy as np
import pytest

from physx_sim import Box, Ground, Robot, World
from physx_sim.errors import SimulationError

STILL = [0, 0, 0, 0, 0, 0, 1, *np.zeros(12)]


@pytest.fixture
def falling(example):
    """A quadruped and a box in the air, that turn; and a ground far below."""
    robot = Robot(example("a1_description/urdf/a1.urdf"), "a1", fixed_base=False)
    box = Box(name="box", size=(0.1, 0.2, 0.3), position=(2.0, 0.0, 1.0))
    ground = Ground(height=-50.0)
    return World([robot], objects=[box], ground=ground, period=1e-4, contacts="static")


def spun(simulation):
    rng = np.random.default_rng(0)
    layout = simulation.layout
    q = simulation.positions()
    q[3:7] = 0.5, -0.1, 0.7, 0.5
    q[3:7] /= np.linalg.norm(q[3:7])
    q[7:19] += 0.1 * rng.normal(size=12)
    simulation.set_state(q, rng.normal(size=layout.nv))
    simulation.set_torques(rng.normal(size=12))
    simulation.step(20)
    return simulation


def test_accelerations_are_the_change_of_the_velocities(backend, falling):
    with backend.build(falling) as simulation:
        spun(simulation)
        before = simulation.body_velocities()
        simulation.step()
        after = simulation.body_velocities()
        found = simulation.body_accelerations()
        assert found.shape == (len(simulation.layout.bodies), 6)
        # Both are of the first order in the period, of different moments of the step.
        change = (after - before) / 1e-4
        np.testing.assert_allclose(found, change, atol=2e-3 * np.abs(change).max())


def test_accelerations_of_bodies_follow_from_those_of_the_state(backend, falling):
    """J a + dJ/dt v, with dJ/dt by a central difference along the motion."""
    with backend.build(falling) as simulation:
        spun(simulation)
        q, v, a = simulation.positions(), simulation.velocities(), simulation.accelerations()
        stride, found = 1e-6, simulation.body_accelerations(["FL_foot", "box"])
        for body, row in zip(["FL_foot", "box"], found, strict=True):
            ahead, behind = (
                simulation.jacobian(body, moved(simulation.layout, q, sign * stride * v)) @ v
                for sign in (1, -1)
            )
            expected = simulation.jacobian(body, q) @ a + (ahead - behind) / (2 * stride)
            np.testing.assert_allclose(row, expected, atol=1e-6 * np.abs(expected).max())


def moved(layout, q, motion):
    """Return positions after a small motion along the velocities."""
    found = q.copy()
    for part in layout.parts.values():
        begin, along = part.positions.start, motion[part.velocities]
        x, y, z, w = q[begin + 3 : begin + 7]
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        found[begin : begin + 3] += turn @ along[:3]
        a, b, c = 0.5 * along[3:6]
        found[begin + 3 : begin + 7] += (
            w * a + y * c - z * b,
            w * b + z * a - x * c,
            w * c + x * b - y * a,
            -(x * a + y * b + z * c),
        )
        found[begin + 3 : begin + 7] /= np.linalg.norm(found[begin + 3 : begin + 7])
        found[begin + 7 : part.positions.stop] += along[6:]
    return found


def test_engines_agree(dart, pinocchio, falling):
    with dart.build(falling) as one, pinocchio.build(falling) as other:
        for simulation in (one, other):
            spun(simulation)
        mine, theirs = one.body_motions(), other.body_motions()
        scale = np.abs(mine[:, 13:]).max()
        np.testing.assert_allclose(mine[:, :13], theirs[:, :13], atol=1e-6)
        np.testing.assert_allclose(mine[:, 13:], theirs[:, 13:], atol=1e-5 * scale)


def test_body_motions_are_poses_velocities_and_accelerations(backend, falling):
    with backend.build(falling) as simulation:
        spun(simulation)
        names = ["box", "trunk", "ground", "RR_foot"]
        found = simulation.body_motions(names)
        parts = [
            simulation.body_poses(names),
            simulation.body_velocities(names),
            simulation.body_accelerations(names),
        ]
        np.testing.assert_array_equal(found, np.concatenate(parts, axis=1))
        q, v = simulation.positions(), simulation.velocities()
        np.testing.assert_allclose(parts[0], simulation.body_poses(names, q), atol=1e-12)
        np.testing.assert_allclose(parts[1], simulation.body_velocities(names, q, v), atol=1e-12)
        assert (parts[0][:, 6] >= 0).all()
        assert found[2].tolist() == STILL
        everything = simulation.body_motions()
        np.testing.assert_array_equal(everything[simulation.layout.bodies.index("box")], found[0])
        before = everything.copy()
        simulation.step()
        np.testing.assert_array_equal(everything, before)  # a copy
        with pytest.raises(SimulationError, match="trunkk"):
            simulation.body_motions(["trunkk"])
        with pytest.raises(SimulationError, match="list of names"):
            simulation.body_accelerations("trunk")


def test_before_the_first_step_accelerations_are_centripetal_only(backend, bar):
    with backend.build(World([bar()])) as simulation:
        assert not simulation.body_accelerations().any()
        simulation.set_state([0.0], [2.0])
        tip = simulation.body_accelerations(["tip"])[0]
        np.testing.assert_allclose(tip, [0, 0, 4, 0, 0, 0], atol=1e-12)


def test_commands_returns_the_held_commands(backend, bar):
    robot = bar('<limit effort="2" velocity="0"/>')
    with backend.build(World([robot])) as simulation:
        given = np.array([1.0])
        simulation.set_commands(given)
        given[0] = 7.0
        assert simulation.commands().tolist() == [1]
        simulation.set_torques([-5.0])
        assert simulation.commands().tolist() == [-2]
        simulation.commands()[0] = 9.0
        assert simulation.commands().tolist() == [-2]
