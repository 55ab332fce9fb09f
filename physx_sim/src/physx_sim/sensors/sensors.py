"""Sensors of a simulation, which measure at their own periods and with imperfections."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ComponentNotFoundError, ConfigError
from physx_core.typing import Vector
from physx_sim.backend import Simulation
from physx_sim.description.world import World
from physx_sim.devices import check_unique, steps_of
from physx_sim.errors import SimulationError
from physx_sim.sensors.ideal import groups_of
from physx_sim.sensors.imperfections import Components, Delays, Errors, Mask
from physx_sim.sensors.sensor import Sensor


@dataclass(frozen=True)
class SensorState:
    """A snapshot of sensors; plain and picklable.

    Attributes:
        values: Last measurements, shape (components,).
        ideal: The same without errors and delay.
        past: Earlier ideal values.
        counts: Number of measurements of each sensor.
        bias: Constant errors.
        walk: Random walks.
        frame: Frame of the last measurement; -1: none yet.
        rng: State of the random generator; None if nothing is drawn.
    """

    values: Vector
    ideal: Vector
    past: Vector
    counts: NDArray[np.int64]
    bias: Vector
    walk: Vector
    frame: int
    rng: Mapping[str, Any] | None


class Sensors:
    """Sensors of a simulation: each measures at its own period.

    As a hook of the simulation they run automatically before each physics step; `update` measures
    what is due after the last step, and never measures twice::

        sensors = Sensors(simulation, world, [Encoder(name="knee", joint="knee", noise=1e-3)], rng)
        simulation.add_hook(sensors)
        simulation.step(10)
        sensors.update(simulation)
        sensors["knee"]["position"]

    All sensors measure at the first update, regardless of their periods, then at frames that are
    multiples of their periods. They keep no reference to the simulation and can be pickled. Call
    `reset` after `Simulation.set_state`, and their `snapshot` and `restore` along with the
    simulation's.

    `view` and `block` give the measurements without a copy, always in the same memory. Sensors
    without noise, bias, and delay are the cheapest.

    Attributes:
        sensors: The sensors, in the order of the values: grouped by kind, in the given order.
        dtype: Record of all values: a nested record for each sensor, by name, with its quantities
            by name. All are float64, without gaps.
        size: Total number of values.
    """

    def __init__(
        self,
        simulation: Simulation,
        world: World,
        sensors: Sequence[Sensor],
        rng: np.random.Generator | None = None,
    ) -> None:
        """Attach sensors to a simulation's bodies and joints; they measure nothing yet.

        Args:
            simulation: The simulation that they measure.
            world: The world that the simulation was built from.
            sensors: Sensors with distinct names.
            rng: Source of biases, noise, random walks, and jitter.

        Raises:
            ComponentNotFoundError: If the simulation has no joint or body with a given name.
            ConfigError: If two sensors share a name, a period is not a multiple of the physics
                period, a joint's torque is unknown, or `rng` is missing.
            FeatureNotSupportedError: If the engine lacks a feature that a sensor needs.
        """
        kinds = list(dict.fromkeys(type(sensor) for sensor in sensors))
        sensors = sorted(
            sensors,
            key=lambda one: (kinds.index(type(one)), sum(one.quantities.values())),
        )
        self.sensors = tuple(sensors)
        check_unique("sensors", [sensor.name for sensor in sensors])
        every = [
            steps_of(f'{type(each).__name__} "{each.name}": period', each.period, simulation.period)
            for each in sensors
        ]
        self._every = np.array(every)
        self._hook_every = int(np.gcd.reduce(self._every))
        self._components = Components(sensors)
        self.size = self._components.count
        self.dtype = np.dtype([(each.name, _record(each)) for each in sensors])
        self._groups = groups_of(sensors, every, simulation, world)
        periods = self._every * simulation.period
        self._delays = Delays(sensors, self._components, periods)
        self._errors = Errors(sensors, self._components, periods)
        if rng is None and (self._delays.draws or self._errors.draws):
            raise ConfigError(
                "Noise, bias_deviation, random_walk, and jitter need random numbers: pass "
                "Sensors(..., rng=np.random.default_rng(seed))."
            )
        self._rng, self._frame = rng, -1
        self._exact = not (self._delays.acts or self._errors.acts)
        self._ideal = np.full(self.size, np.nan)
        self._values = self._ideal if self._exact else self._ideal.copy()
        self._arrange()
        self._errors.begin(rng)

    def _arrange(self) -> None:
        """Create the groups' views, which are not pickled."""
        self._blocks = [(group, group.block(self._ideal)) for group in self._groups]

    def __getstate__(self) -> dict[str, Any]:
        """Return everything but the views."""
        return {name: value for name, value in vars(self).items() if name != "_blocks"}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        """Restore the attributes and the views."""
        vars(self).update(state)
        self._arrange()

    # Measuring ------------------------------------------------------------------------------

    def update(self, simulation: Simulation) -> None:
        """Measure what is due in the current frame, unless already done."""
        frame = simulation.frame
        if frame == self._frame:
            return
        first = self._frame < 0
        if not first and frame % self._hook_every:
            return
        if not self._exact:
            self._measure(simulation, frame, first)
            return
        for group, block in self._blocks:
            if group.measure(simulation, block, frame, first):
                self._frame = frame

    def _measure(self, simulation: Simulation, frame: int, first: bool) -> None:
        """Measure what is due, with errors."""
        due: Mask = np.full(len(self.sensors), first) | (frame % self._every == 0)
        if not due.any():
            return
        for group, block in self._blocks:
            group.measure(simulation, block, frame, first)
        self._frame, seen = frame, self._ideal
        if self._delays.acts:
            seen = self._delays.delay(seen, due, self._rng)
        if self._errors.acts:
            seen = self._errors.add(seen, due, self._rng)
        if due.all():
            self._values[:] = seen
        else:
            np.copyto(self._values, seen, where=due[self._components.owners])

    __call__ = update

    def attach(self, simulation: Simulation) -> Self:
        """Run before each of a simulation's steps from now on; return these sensors."""
        simulation.add_hook(self, self._hook_every)
        return self

    # Reading --------------------------------------------------------------------------------

    @property
    def view(self) -> Vector:
        """The measurements, shape (size,): read-only, always the same memory, initially NaN."""
        return _read_only(self._values)

    def block(self, kind: type[Sensor]) -> Vector:
        """Return the measurements of one kind of sensor, shape (sensors, components).

        This is part of `view`: read-only, always the same memory, initially NaN. Rows are in the
        order of `sensors`.

        Raises:
            ComponentNotFoundError: If there is no sensor of that kind.
            SimulationError: If sensors of that kind have different numbers of rays.
        """
        found = [group for group in self._groups if group.kind is kind]
        if len(found) > 1:
            raise SimulationError(
                f"The sensors of the kind {kind.__name__} differ in size: read each by its name."
            )
        for group in found:
            return _read_only(group.block(self._values))
        known = [group.kind.__name__ for group in self._groups]
        name = getattr(kind, "__name__", str(kind))
        raise ComponentNotFoundError("kind of sensor", name, "The set", known)

    @property
    def values(self) -> Vector:
        """The last measurements, shape (size,); a copy.

        Raises:
            SimulationError: If nothing has been measured yet.
        """
        self._check_measured()
        return self._values.copy()

    @property
    def ideal(self) -> Vector:
        """The last measurements without errors and delay, shape (size,); a copy.

        Raises:
            SimulationError: If nothing has been measured yet.
        """
        self._check_measured()
        return self._ideal.copy()

    def read(self) -> Any:
        """Return the last measurements as one record of `dtype`; a copy.

        Raises:
            SimulationError: If nothing has been measured yet.
        """
        return self.values.view(self.dtype)[0]

    def __getitem__(self, name: str) -> Any:
        """Return the last measurement of one sensor: a record of its quantities; a copy.

        Raises:
            ComponentNotFoundError: If there is no sensor with that name.
            SimulationError: If nothing has been measured yet.
        """
        if name not in (self.dtype.names or ()):
            known = self.dtype.names or ()
            raise ComponentNotFoundError("sensor", str(name), "The set", known)
        return self.read()[name]

    def _check_measured(self) -> None:
        if self._frame < 0:
            raise SimulationError("The sensors have not measured yet: call update(simulation).")

    # State ----------------------------------------------------------------------------------

    def reset(self, rng: np.random.Generator | None = None) -> None:
        """Discard all measurements and draw new biases.

        Args:
            rng: New source of random numbers; None: keep the current one.
        """
        if rng is not None:
            self._rng = rng
        self._values[:] = self._ideal[:] = np.nan
        self._frame = -1
        self._delays.clear()
        self._errors.begin(self._rng)

    def snapshot(self) -> SensorState:
        """Return everything that `restore` needs to continue exactly from here."""
        rng = self._rng
        return SensorState(
            self._values.copy(),
            self._ideal.copy(),
            self._delays.past.copy(),
            self._delays.counts.copy(),
            self._errors.bias.copy(),
            self._errors.walk.copy(),
            self._frame,
            None if rng is None else copy.deepcopy(dict(rng.bit_generator.state)),
        )

    def restore(self, state: SensorState) -> None:
        """Return to a snapshot, including the state of the random generator.

        Raises:
            SimulationError: If the snapshot belongs to other sensors.
        """
        for name, own in vars(self.snapshot()).items():
            given: Any = getattr(state, name, None)
            fits = np.shape(given) == np.shape(own) if isinstance(own, np.ndarray) else True
            if not fits or (given is None) != (own is None):
                raise SimulationError(f"The snapshot is not of these sensors: {name} differs.")
        self._ideal[:], self._values[:] = state.ideal, state.values
        self._delays.past, self._delays.counts = state.past.copy(), state.counts.copy()
        self._errors.bias, self._errors.walk = state.bias.copy(), state.walk.copy()
        self._frame = state.frame
        if self._rng is not None and state.rng is not None:
            self._rng.bit_generator.state = copy.deepcopy(dict(state.rng))


def _read_only(values: Vector) -> Vector:
    found = values.view()
    found.flags.writeable = False
    return found


def _record(sensor: Sensor) -> np.dtype[np.void]:
    """Return the record type of one sensor's quantities."""
    return np.dtype(
        [
            (name, np.float64, shape) if (shape := sensor.shape_of(name)) else (name, np.float64)
            for name in sensor.quantities
        ]
    )
