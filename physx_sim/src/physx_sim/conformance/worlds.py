"""The worlds in which engines are checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.typing import Vector
from physx_sim import Backend, Box, Ground, Robot, Simulation, Sphere, World
from physx_sim.errors import FeatureNotSupportedError
from physx_testing.report import NotApplicableError
from physx_testing.subject import Subject

PERIOD = 1e-3
GRAVITY = 9.81
ARM = Path(__file__).with_name("arm.urdf")
ARM_JOINTS = ("waist", "elbow", "drawer")
PENDULUM = Path(__file__).with_name("pendulum.urdf")
PENDULUM_MASS, PENDULUM_LENGTH, PENDULUM_INERTIA = 2.0, 0.5, 0.1 + 2.0 * 0.25
"""Mass in kg, distance of the center of mass from the hinge in m, inertia about it in kg m²."""


def build(subject: Subject, world: World) -> Simulation:
    """Return a new simulation of a world."""
    backend: Backend = subject.make()
    return backend.build(world, seed=0)


def arm(*, robot: Mapping[str, Any] | None = None, **options: Any) -> World:
    """Return a world with only an arm: two hinges and a slide.

    Args:
        robot: Options of the robot.
        options: Options of the world.
    """
    made = Robot(ARM, name="arm", collisions="none", **(robot or {}))
    return World(robots=[made], period=PERIOD, contacts="none", **options)


def pendulum(**options: Any) -> World:
    """Return a world with a pendulum."""
    robot = Robot(PENDULUM, name="pendulum", collisions="none")
    return World(robots=[robot], period=PERIOD, contacts="none", **options)


def ball(**options: Any) -> World:
    """Return a world with a ball in the air that touches nothing."""
    sphere = Sphere(name="ball", radius=0.1, mass=0.5, position=(0.0, 0.0, 2.0))
    return World(objects=[sphere], period=PERIOD, contacts="none", **options)


def box(height: float = 0.1, friction: float = 1.0, **options: Any) -> World:
    """Return a world with a 0.2 m, 2 kg box on the ground or above it."""
    cube = Box(
        name="box", size=(0.2, 0.2, 0.2), mass=2.0, position=(0.0, 0.0, height), friction=friction
    )
    return World(objects=[cube], ground=Ground(), period=PERIOD, **options)


def busy(subject: Subject) -> World:
    """Return a world with an arm, a box and a ball that fall to the ground if there are contacts.

    An engine without contacts gets no ground; one without objects gets only the arm.
    """
    cube = Box(name="box", size=(0.2, 0.2, 0.2), mass=2.0, position=(1.0, 0.0, 0.15))
    sphere = Sphere(name="ball", radius=0.1, mass=0.5, position=(-1.0, 0.0, 0.2))
    robot = Robot(ARM, name="arm", collisions="none", position=(0.0, 0.0, 1.0))
    whole = World(robots=[robot], objects=[cube, sphere], ground=Ground(), period=PERIOD)
    for world in (whole, dataclasses.replace(whole, ground=None, contacts="none")):
        try:
            build(subject, world).close()
        except FeatureNotSupportedError:
            continue
        return world
    return arm()


def state_of(simulation: Simulation, seed: int = 0) -> tuple[Vector, Vector]:
    """Return a state within the limits in which everything moves."""
    random, layout = np.random.default_rng(seed), simulation.layout
    positions = simulation.positions().copy()
    for name, place in layout.position_index.items():
        number = layout.joints.index(name)
        low, high = max(layout.lower[number], -2.0), min(layout.upper[number], 2.0)
        positions[place] = low + (0.2 + 0.6 * random.random()) * (high - low)
    for part in layout.parts.values():
        if part.floating:
            first = part.positions.start
            positions[first : first + 3] += 0.1 * random.standard_normal(3)
            turn = random.standard_normal(4)
            positions[first + 3 : first + 7] = turn / np.linalg.norm(turn)
    return positions, 0.5 * random.standard_normal(layout.nv)


def need(subject: Subject, feature: str) -> None:
    """Skip a check if an engine lacks a feature.

    Raises:
        NotApplicableError: If it lacks the feature.
    """
    with build(subject, busy(subject)) as simulation:
        if feature not in simulation.features:
            raise NotApplicableError(f'it lacks the feature "{feature}"')
