"""Sensors of one kind, which measure together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physx_core.simulation.backend import Simulation
from physx_core.simulation.description import World
from physx_core.simulation.sensors.ideal import Truth, truth_of
from physx_core.simulation.sensors.sensor import Sensor
from physx_core.typing import Vector


@dataclass(frozen=True, eq=False)
class Group:
    """All sensors of one kind, and where their components are.

    Attributes:
        kind: Their class.
        truth: What measures them.
        components: Their part of the values.
        shape: Of their block: sensors, components of each.
        every: Frames between two measurements of each, shape (sensors,).
        shared_every: That of all of them; None where it differs.
    """

    kind: type[Sensor]
    truth: Truth
    components: slice
    shape: tuple[int, int]
    every: NDArray[np.int64]
    shared_every: int | None

    def block(self, values: Vector) -> Vector:
        """Return their part of all values, as a view."""
        return values[self.components].reshape(self.shape)

    def measure(self, simulation: Simulation, out: Vector, frame: int, first: bool) -> bool:
        """Write what those that are due measure; return whether any was.

        Args:
            simulation: What they measure.
            out: Their block of the true values; those of others stay.
            frame: The present frame.
            first: Whether all are due, whatever the frame.
        """
        if first or (self.shared_every is not None and frame % self.shared_every == 0):
            self.truth.measure(simulation, out)
            return True
        if self.shared_every is not None:
            return False
        due = frame % self.every == 0
        if not due.any():
            return False
        measured = np.empty(self.shape)
        self.truth.measure(simulation, measured)
        out[due] = measured[due]
        return True


def groups_of(
    sensors: Sequence[Sensor], every: Sequence[int], simulation: Simulation, world: World
) -> list[Group]:
    """Return the groups of sensors; those of one kind must follow each other.

    Args:
        sensors: The sensors.
        every: Frames between two measurements of each.
        simulation: What they measure.
        world: What the simulation was built from.

    Raises:
        ComponentNotFoundError: A joint or body is not in the simulation.
        ConfigError: A kind is unknown, or a joint's torque is not known.
        FeatureNotSupportedError: The engine lacks what a kind needs.
    """
    found, begin = [], 0
    for kind in dict.fromkeys(type(sensor) for sensor in sensors):
        places = [place for place, sensor in enumerate(sensors) if type(sensor) is kind]
        steps = [every[place] for place in places]
        shape = len(places), sum(kind.quantities.values())
        end = begin + shape[0] * shape[1]
        found.append(
            Group(
                kind,
                truth_of(kind, [sensors[place] for place in places], simulation, world),
                slice(begin, end),
                shape,
                np.array(steps),
                steps[0] if len(set(steps)) == 1 else None,
            )
        )
        begin = end
    return found
