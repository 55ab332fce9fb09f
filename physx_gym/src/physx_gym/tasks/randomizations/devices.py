"""Randomization of sensors and controllers: gains, delays, noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from numpy.random import Generator

from physx_core.errors import ComponentNotFoundError, ConfigError, listed
from physx_gym.blocks.pd_controller import PDController
from physx_gym.env.pipeline_env import PipelineEnv
from physx_gym.tasks.randomizations.randomization import (
    Drawn,
    Nominal,
    Randomization,
    Range,
    check_range,
    chosen,
)
from physx_sim import Sensor


class RandomGains(Randomization):
    """Multiplies the gains of a `PDController`, with different factors for each motor."""

    def __init__(
        self,
        kp: Range = (1.0, 1.0),
        kd: Range = (1.0, 1.0),
        block: str | None = None,
        name: str | None = None,
    ) -> None:
        """Choose the controller.

        Args:
            kp: Range of the factors of the torque per unit of position error.
            kd: Range of the factors of the torque per unit of velocity error.
            block: Name of the controller, which is below this layer; None: the only one.
            name: Name in the log; None: that of the class.
        """
        super().__init__(name)
        self.kp, self.kd = check_range("RandomGains.kp", kp), check_range("RandomGains.kd", kd)
        self.block = block

    def draw(self, nominal: Nominal, random: Generator) -> Drawn:
        """Return the factors of each motor."""
        motors = len(self._find(nominal.env).joints.names)
        ranges = {"kp": self.kp, "kd": self.kd}
        return {key: random.uniform(*own, motors).tolist() for key, own in ranges.items()}

    def apply(self, env: PipelineEnv, drawn: Drawn) -> None:
        """Multiply the gains."""
        self._find(env).scale_gains(drawn["kp"], drawn["kd"])

    def _find(self, env: PipelineEnv) -> PDController:
        """Return the controller in the pipeline."""
        blocks = [getattr(layer, "block", None) for layer in env.layers]
        found = {each.name: each for each in blocks if isinstance(each, PDController)}
        if self.block is None and len(found) == 1:
            return next(iter(found.values()))
        if self.block is None:
            raise ConfigError(
                f"RandomGains needs exactly one PDController below it, or block= the name of one: "
                f"{listed(found)}."
            )
        if self.block not in found:
            raise ComponentNotFoundError("PDController", self.block, "The pipeline", list(found))
        return found[self.block]


class RandomDelays(Randomization):
    """Delays each sensor by a different time."""

    def __init__(
        self, delay: Range, sensors: Sequence[str] | None = None, name: str | None = None
    ) -> None:
        """Choose the sensors.

        Args:
            delay: Range of the delays, in s.
            sensors: Their names; None: all.
            name: Name in the log; None: that of the class.
        """
        super().__init__(name)
        self.delay, self.sensors = check_range("RandomDelays.delay", delay), sensors

    def draw(self, nominal: Nominal, random: Generator) -> Drawn:
        """Return the delay of each sensor, in s."""
        names = chosen("sensor", "The robot", self.sensors, list(nominal.options["sensors"]))
        return {each: random.uniform(*self.delay) for each in names}

    def options(self, nominal: Nominal, drawn: Drawn) -> Mapping[str, Any]:
        """Return the delays."""
        return {"sensors": {each: {"delay": delay} for each, delay in drawn.items()}}


class RandomNoise(Randomization):
    """Gives the measurements of quantities white noise of a random standard deviation."""

    def __init__(
        self,
        deviation: Mapping[str, Range],
        sensors: Sequence[str] | None = None,
        name: str | None = None,
    ) -> None:
        """Choose the quantities.

        Args:
            deviation: Range of the standard deviation for each quantity, such as ``"velocity"``, in
                its unit.
            sensors: Names of the sensors; None: all that measure one of the quantities.
            name: Name in the log; None: that of the class.

        Raises:
            ConfigError: If `deviation` is empty or not a mapping, or a range is invalid.
        """
        super().__init__(name)
        if not isinstance(deviation, Mapping) or not deviation:
            raise ConfigError(
                f"RandomNoise.deviation is {deviation!r} but must be a mapping of quantities to "
                "ranges."
            )
        self.deviation = {
            quantity: check_range(f'RandomNoise.deviation["{quantity}"]', each)
            for quantity, each in deviation.items()
        }
        self.sensors = sensors

    def draw(self, nominal: Nominal, random: Generator) -> Drawn:
        """Return the standard deviations of each sensor.

        Raises:
            ComponentNotFoundError: If a sensor does not exist, or none of them measures one of the
                quantities.
        """
        every = {sensor.name: sensor for sensor in nominal.env.simulator.sensors}
        names = chosen("sensor", "The robot", self.sensors, list(every))
        measured = {quantity for each in names for quantity in every[each].error_widths()}
        for quantity in self.deviation:
            if quantity not in measured:
                raise ComponentNotFoundError("quantity", quantity, "The sensors", sorted(measured))
        found = {
            each: {
                quantity: random.uniform(*own)
                for quantity, own in self.deviation.items()
                if quantity in every[each].error_widths()
            }
            for each in names
        }
        return {each: own for each, own in found.items() if own}

    def options(self, nominal: Nominal, drawn: Drawn) -> Mapping[str, Any]:
        """Return the noise of the sensors; that of other quantities is unchanged."""
        every = {sensor.name: sensor for sensor in nominal.env.simulator.sensors}
        found = {}
        for each, own in drawn.items():
            before = nominal.options["sensors"][each]["noise"]
            found[each] = {"noise": {**_by_quantity(every[each], before), **own}}
        return {"sensors": found}


def _by_quantity(sensor: Sensor, noise: Any) -> Mapping[str, Any]:
    """Return noise, which may be one number for all quantities, by quantity."""
    return noise if isinstance(noise, Mapping) else dict.fromkeys(sensor.error_widths(), noise)
