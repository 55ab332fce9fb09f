"""Contacts of moving bodies with each other and with edges and faces, against known physics."""

from __future__ import annotations

import math

import numpy as np
import pytest

from physx_sim import Box, Capsule, Cylinder, Ground, Sphere, World

CALM = {"gravity": (0.0, 0.0, 0.0)}


@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_a_collision_keeps_momentum_and_obeys_the_restitution(backend, restitution):
    balls = [
        Sphere(name="a", radius=0.1, mass=1.0, position=(0, 0, 0), restitution=restitution),
        Sphere(name="b", radius=0.1, mass=2.0, position=(0.3, 0, 0), restitution=restitution),
    ]
    with backend.build(World(objects=balls, **CALM)) as simulation:
        v = simulation.velocities()
        v[0] = 1.0
        simulation.set_state(simulation.positions(), v)
        simulation.step(300)
        a, b = simulation.velocities()[[0, 6]]
        np.testing.assert_allclose(a + 2 * b, 1.0, atol=1e-9)
        np.testing.assert_allclose(b - a, restitution, atol=1e-4)


def test_a_cradle_hands_its_speed_on(backend):
    balls = [
        Sphere(
            name=f"ball{i}", radius=0.1, position=(0.2005 * i, 0, 0), restitution=1.0, friction=0.0
        )
        for i in range(5)
    ]
    with backend.build(World(objects=balls, **CALM)) as simulation:
        v = simulation.velocities()
        v[0] = 1.0
        simulation.set_state(simulation.positions(), v)
        simulation.step(200)
        np.testing.assert_allclose(simulation.velocities()[::6], [0, 0, 0, 0, 1], atol=1e-3)


@pytest.mark.slow
def test_a_stack_rests_and_the_ground_carries_it(backend):
    boxes = [
        Box(name=f"box{i}", size=(0.2, 0.2, 0.2), position=(0, 0, 0.1 + 0.2 * i)) for i in range(5)
    ]
    with backend.build(World(objects=boxes, ground=Ground())) as simulation:
        simulation.step(400)
        poses = simulation.positions().reshape(5, 7)
        np.testing.assert_allclose(poses[:, 2], 0.1 + 0.2 * np.arange(5), atol=1e-4)
        assert np.abs(poses[:, :2]).max() < 1e-3
        contacts = simulation.contacts()
        ground = simulation.layout.names.index("ground")
        force = contacts["force"][contacts["body_b"] == ground].sum(axis=0)
        np.testing.assert_allclose(force, [0, 0, 5 * 9.81], atol=0.02 * 5 * 9.81)


@pytest.mark.slow
def test_friction_between_bodies_carries_along(backend):
    """A brick on a sliding plank is dragged by friction until both have the same speed."""
    plank = Box(name="plank", size=(2.0, 0.4, 0.1), mass=3.0, position=(0, 0, 0.05), friction=0.3)
    brick = Box(name="brick", size=(0.2, 0.2, 0.1), mass=1.0, position=(0.3, 0, 0.15), friction=0.3)
    world = World(objects=[plank, brick], ground=Ground(friction=0.0))
    with backend.build(world) as simulation:
        simulation.step(20)
        v = simulation.velocities()
        v[0] = 1.0
        simulation.set_state(simulation.positions(), v)
        simulation.step(100)
        np.testing.assert_allclose(simulation.velocities()[6], 0.3 * 9.81 * 0.1, rtol=0.02)
        simulation.step(400)
        np.testing.assert_allclose(simulation.velocities()[[0, 6]], 0.75, atol=1e-3)


def test_an_edge_rests_across_an_edge(backend):
    """Neither has a corner near the other: only their edges cross."""
    turned = (0.0, math.sin(math.pi / 8), 0.0, math.cos(math.pi / 8))
    beams = [
        Box(
            name="low", size=(0.1, 1.0, 0.1), static=True, position=(0, 0, 0.5), orientation=turned
        ),
        Box(name="high", size=(1.0, 0.1, 0.1), position=(0, 0, 0.62)),
    ]
    with backend.build(World(objects=beams)) as simulation:
        simulation.step(300)
        height = 0.5 + 0.05 * math.sqrt(2) + 0.05
        np.testing.assert_allclose(simulation.positions()[:3], [0, 0, height], atol=2e-3)


@pytest.mark.parametrize("shape", ["box", "sphere", "capsule", "cylinder"])
def test_shapes_rest_on_a_static_table(backend, shape):
    thing = {
        "box": Box(name="it", size=(0.2, 0.2, 0.2), position=(0.3, 0, 1.1)),
        "sphere": Sphere(name="it", radius=0.1, position=(0.3, 0, 1.1)),
        "capsule": Capsule(
            name="it",
            radius=0.1,
            length=0.3,
            position=(0.3, 0, 1.1),
            orientation=(0.5, 0.5, 0.5, 0.5),
        ),
        "cylinder": Cylinder(
            name="it",
            radius=0.1,
            length=0.3,
            position=(0.3, 0, 1.1),
            orientation=(0.5, 0.5, 0.5, 0.5),
        ),
    }[shape]
    table = Box(name="table", size=(2.0, 2.0, 0.1), static=True, position=(0, 0, 0.95))
    with backend.build(World(objects=[thing, table])) as simulation:
        simulation.step(300)
        np.testing.assert_allclose(simulation.positions()[:3], [0.3, 0, 1.1], atol=2e-3)
        force = simulation.contacts()["force"].sum(axis=0)
        np.testing.assert_allclose(force, [0, 0, 9.81], atol=0.02)


@pytest.mark.reported(
    "gym#1193",
    "mujoco#493",
    "bullet3#2982",
    about="a state that was saved in contact does not go on identically",
)
def test_restore_gives_the_same_bits_among_bodies(backend):
    boxes = [
        Box(name=f"box{i}", size=(0.2, 0.15, 0.1), position=(0.03 * i, 0.02 * i, 0.1 + 0.15 * i))
        for i in range(3)
    ]
    with backend.build(World(objects=boxes, ground=Ground())) as simulation:
        simulation.step(150)
        state = simulation.snapshot()
        simulation.step(150)
        expected = simulation.positions()
        simulation.restore(state)
        simulation.step(150)
        np.testing.assert_array_equal(simulation.positions(), expected)


def test_nothing_touches_a_table_without_contacts(backend):
    ball = Sphere(name="ball", radius=0.1, position=(0, 0, 1.2))
    table = Box(name="table", size=(2.0, 2.0, 0.1), static=True, position=(0, 0, 0.95))
    for contacts, rests in (("none", False), ("static", True)):
        with backend.build(World(objects=[ball, table], contacts=contacts)) as simulation:
            simulation.step(600)
            assert (simulation.positions()[2] > 1.0) == rests
