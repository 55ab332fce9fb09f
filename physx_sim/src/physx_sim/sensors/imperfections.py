"""Imperfections of all sensors at once: delay, jitter, bias, random walk, and noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from physx_core.rotations import from_rotation_vector_rows, interpolate_rows, multiply_rows
from physx_core.typing import Vector
from physx_sim.sensors.sensor import Sensor

Mask = NDArray[np.bool_]


class Components:
    """Indices of the sensors' components and errors in flat vectors.

    Attributes:
        count: Total number of components.
        owners: Sensor of each component.
        orientations: Components of the orientations, shape (n, 4).
        switches: Components that are 0 or 1.
        error_count: Total number of errors.
        error_owners: Sensor of each error.
        shifted: Components with an additive error.
        shifts: Their additive errors.
        turns: Errors of the orientations, shape (n, 3).
    """

    def __init__(self, sensors: Sequence[Sensor]) -> None:
        owners: list[int] = []
        error_owners: list[int] = []
        orientations, switches, shifted, shifts, turns = [], [], [], [], []
        for owner, sensor in enumerate(sensors):
            widths = sensor.error_widths()
            for name, width in sensor.quantities.items():
                components = [*range(len(owners), len(owners) + width)]
                errors = [*range(len(error_owners), len(error_owners) + widths.get(name, 0))]
                owners += [owner] * width
                error_owners += [owner] * len(errors)
                if name == "orientation":
                    orientations.append(components)
                    turns.append(errors)
                elif errors:
                    shifted += components
                    shifts += errors
                else:
                    switches += components
        self.count, self.error_count = len(owners), len(error_owners)
        self.owners, self.error_owners = np.array(owners), np.array(error_owners)
        self.orientations = np.array(orientations, np.intp).reshape(-1, 4)
        self.turns = np.array(turns, np.intp).reshape(-1, 3)
        self.switches = np.array(switches, np.intp)
        self.shifted, self.shifts = np.array(shifted, np.intp), np.array(shifts, np.intp)


class Delays:
    """Delays of sensors, and the past values that they need.

    Attributes:
        acts: Whether any sensor has a delay.
        past: The last ideal values, shape (kept, components), a ring buffer for each component.
        counts: Number of values each sensor has measured, shape (sensors,).
    """

    def __init__(self, sensors: Sequence[Sensor], components: Components, periods: Vector) -> None:
        self._components = components
        self._lag = np.array([sensor.delay for sensor in sensors]) / periods
        self._jitter = np.array([sensor.jitter for sensor in sensors]) / periods
        self._shaken = np.flatnonzero(self._jitter)
        self._linear = np.array([sensor.interpolation for sensor in sensors]) == 1
        longest = float((self._lag + self._jitter).max())
        self.acts = longest > 0
        self.draws = bool(len(self._shaken))
        self._kept = int(np.ceil(longest)) + 2 if self.acts else 1
        self._column = np.arange(components.count)
        self.clear()

    def clear(self) -> None:
        """Discard all past values."""
        self.past = np.zeros((self._kept, self._components.count))
        self.past[:, self._components.orientations[:, 3]] = 1.0
        self.counts = np.zeros(len(self._lag), np.int64)

    def delay(self, ideal: Vector, due: Mask, rng: np.random.Generator | None) -> Vector:
        """Keep the ideal values of the sensors that are due; return the delayed values.

        Args:
            ideal: Shape (components,).
            due: Which sensors are due, shape (sensors,); values of the others are meaningless.
            rng: For the jitter.
        """
        owners = self._components.owners
        mine = due[owners]
        slots = self.counts[owners] % self._kept
        self.past[slots[mine], self._column[mine]] = ideal[mine]
        lag = self._lag
        if self.draws and rng is not None:
            lag = lag.copy()
            lag[self._shaken] += rng.random(len(self._shaken)) * self._jitter[self._shaken]
        lag = np.minimum(lag, self.counts)  # the first value also stands for all times before it
        nearest = np.rint(lag)
        lag = np.where(np.abs(lag - nearest) < 1e-9 * (1 + lag), nearest, lag)
        whole = np.where(self._linear, np.floor(lag), np.ceil(lag)).astype(np.int64)
        share = np.where(self._linear, lag - whole, 0.0)[owners]
        later: Vector = self.past[(self.counts - whole)[owners] % self._kept, self._column]
        seen = later
        if share.any():
            earlier = self.past[(self.counts - whole - 1)[owners] % self._kept, self._column]
            seen = self._interpolate(later, earlier, share)
        self.counts = self.counts + due
        return seen

    def _interpolate(self, later: Vector, earlier: Vector, share: Vector) -> Vector:
        seen: Vector = later + share * (earlier - later)
        at = self._components.orientations
        if at.size:
            seen[at] = interpolate_rows(later[at], earlier[at], share[at[:, :1]])
        switches = self._components.switches
        seen[switches] = seen[switches] >= 0.5
        return seen


class Errors:
    """Bias, random walk, and noise.

    Attributes:
        bias: Constant errors, given and drawn, shape (errors,).
        walk: Random walks, shape (errors,).
    """

    def __init__(self, sensors: Sequence[Sensor], components: Components, periods: Vector) -> None:
        self._components = components

        def column(option: str) -> Vector:
            amounts = [value for sensor in sensors for value in sensor.amounts(option)]
            return np.array(amounts, np.float64)

        self._noise, self._given = column("noise"), column("bias")
        self._deviation = column("bias_deviation")
        self._stride = column("random_walk") * np.sqrt(periods[components.error_owners])
        self._noisy, self._walking = np.flatnonzero(self._noise), np.flatnonzero(self._stride)
        self._varied = np.flatnonzero(self._deviation)
        self.acts = any(each.any() for each in (self._noise, self._given, self._deviation))
        self.acts = self.acts or bool(len(self._walking))
        self.draws = bool(len(self._noisy) or len(self._walking) or len(self._varied))
        self.bias, self.walk = self._given.copy(), np.zeros(components.error_count)

    def begin(self, rng: np.random.Generator | None) -> None:
        """Draw the biases and start the random walks at 0."""
        self.bias, self.walk = self._given.copy(), np.zeros(self._components.error_count)
        if len(self._varied) and rng is not None:
            drawn = rng.standard_normal(len(self._varied))
            self.bias[self._varied] += self._deviation[self._varied] * drawn

    def add(self, seen: Vector, due: Mask, rng: np.random.Generator | None) -> Vector:
        """Return values with the errors of this measurement; only walks of due sensors advance.

        Args:
            seen: Shape (components,).
            due: Shape (sensors,).
            rng: For the random walk and the noise.
        """
        error = self.bias
        if len(self._walking) and rng is not None:
            at = self._walking
            strides = self._stride[at] * rng.standard_normal(len(at))
            self.walk = self.walk.copy()
            self.walk[at] += np.where(due[self._components.error_owners[at]], strides, 0.0)
            error = error + self.walk
        if len(self._noisy) and rng is not None:
            at = self._noisy
            error = error.copy()
            error[at] += self._noise[at] * rng.standard_normal(len(at))
        components = self._components
        found = seen.copy()
        found[components.shifted] += error[components.shifts]
        if components.orientations.size:
            turns = from_rotation_vector_rows(error[components.turns])
            orientations = components.orientations
            found[orientations] = multiply_rows(seen[orientations], turns)
        return found
