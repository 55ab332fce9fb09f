"""Groups of sensors of one kind, which measure together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physx_core.simulation.backend import Simulation
from physx_core.simulation.description import World
from physx_core.simulation.sensors.ideal import IdealSensors, ideal_sensors
from physx_core.simulation.sensors.sensor import Sensor
from physx_core.typing import Vector


@dataclass(frozen=True, eq=False)
class SensorGroup:
    """All sensors of one kind, and the place of their components.

    Attributes:
        kind: Their class.
        ideal: Their noise-free measurements.
        components: Their part of the values.
        shape: Of their block: sensors, components of each.
        every: Frames between two measurements of each, shape (sensors,).
        shared_every: That of all of them; None where it differs.
    """

    kind: type[Sensor]
    ideal: IdealSensors
    components: slice
    shape: tuple[int, int]
    every: NDArray[np.int64]
    shared_every: int | None

    def block(self, values: Vector) -> Vector:
        """Return their part of all values, as a view."""
        return values[self.components].reshape(self.shape)

    def measure(self, simulation: Simulation, out: Vector, frame: int, first: bool) -> bool:
        """Measure with the sensors that are due; return whether any was.

        Args:
            simulation: The simulation that they measure.
            out: Their block of the ideal values; rows of sensors that are not due stay.
            frame: The current frame.
            first: Whether all are due in any case.
        """
        if first or (self.shared_every is not None and frame % self.shared_every == 0):
            self.ideal.measure(simulation, out)
            return True
        if self.shared_every is not None:
            return False
        due = frame % self.every == 0
        if not due.any():
            return False
        measured = np.empty(self.shape)
        self.ideal.measure(simulation, measured)
        out[due] = measured[due]
        return True


def groups_of(
    sensors: Sequence[Sensor], every: Sequence[int], simulation: Simulation, world: World
) -> list[SensorGroup]:
    """Return the groups of sensors; sensors of one kind must be adjacent.

    Args:
        sensors: The sensors.
        every: Frames between two measurements of each.
        simulation: The simulation that they measure.
        world: The world that the simulation was built from.

    Raises:
        ComponentNotFoundError: If a joint or body is not in the simulation.
        ConfigError: If a kind is unknown, or a joint's torque is not known.
        FeatureNotSupportedError: If the engine lacks what a kind needs.
    """
    found, begin = [], 0
    for kind in dict.fromkeys(type(sensor) for sensor in sensors):
        places = [place for place, sensor in enumerate(sensors) if type(sensor) is kind]
        steps = [every[place] for place in places]
        shape = len(places), sum(kind.quantities.values())
        end = begin + shape[0] * shape[1]
        found.append(
            SensorGroup(
                kind,
                ideal_sensors(kind, [sensors[place] for place in places], simulation, world),
                slice(begin, end),
                shape,
                np.array(steps),
                steps[0] if len(set(steps)) == 1 else None,
            )
        )
        begin = end
    return found
