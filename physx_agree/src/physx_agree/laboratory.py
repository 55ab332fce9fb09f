"""Laboratories: worlds on an engine, in which single steps are repeated from any state."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core import Closeable, plugins
from physx_core.typing import Records, Vector
from physx_sim import Simulation, State, World


@dataclass(frozen=True, eq=False)
class Moment:
    """What determines the next physics step.

    Attributes:
        positions: Shape (nq,).
        velocities: Shape (nv,).
        commands: Shape (joints,), as in `Simulation.set_commands`.
        frame: Number of the step.
    """

    positions: Vector
    velocities: Vector
    commands: Vector
    frame: int = 0

    def but(self, **changes: Any) -> Moment:
        """Return it with some changes."""
        return dataclasses.replace(self, **changes)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a physics step made of a moment.

    Attributes:
        velocities: Shape (nv,).
        contacts: `CONTACT` records.
    """

    velocities: Vector
    contacts: Records


class Laboratory(Closeable):
    """A world on an engine; a context manager.

    Attributes:
        engine: Reference of the engine.
        world: The world.
        simulation: Its simulation.
        first: What each step begins with, but for its moment.
    """

    def __init__(self, engine: Any, world: World, first: State | None = None) -> None:
        """Build the simulation.

        Args:
            engine: Reference of the engine.
            world: The world.
            first: A snapshot whose wrenches, attachments and gravity are those of each step; None:
                those of the world.
        """
        self.engine, self.world, self._given = engine, world, first
        with warnings.catch_warnings():  # the task has already said them
            warnings.simplefilter("ignore")
            self.simulation: Simulation = plugins.resolve("backend", engine).build(world)
        self.first = self.simulation.snapshot() if first is None else first

    def step(self, moment: Moment, steps: int = 1) -> Outcome:
        """Return what steps make of a moment; nothing of earlier steps matters."""
        simulation = self.simulation
        simulation.restore(
            dataclasses.replace(
                self.first,
                positions=moment.positions,
                velocities=moment.velocities,
                commands=moment.commands,
                frame=moment.frame,
                engine="",
                native=(),
            )
        )
        simulation.step(steps)
        touching = "contacts" in simulation.features
        contacts = simulation.contacts() if touching else np.zeros(0, self.first.contacts.dtype)
        return Outcome(simulation.velocities(), contacts)

    def with_world(self, world: World) -> Laboratory:
        """Return a laboratory with another world on the same engine."""
        return Laboratory(self.engine, world, self._given)

    def close(self) -> None:
        """Free the simulation."""
        self.simulation.close()
