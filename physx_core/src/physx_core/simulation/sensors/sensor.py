"""What a sensor is: plain, picklable data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from physx_core import checks
from physx_core.errors import ConfigError, UnknownOptionError

Amounts = float | Mapping[str, Any]
"""A number for all components; or for each quantity a number, or one number for each component."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """What all sensors have.

    A measurement is the true value as it was `delay` plus a part of `jitter` ago, plus the bias,
    plus noise. Errors are in the units of what is measured; those of an orientation are small
    rotations about the sensor's own axes, in rad.

    Attributes:
        name: Name of the sensor.
        period: Time between two measurements, in s; a multiple of the physics' period; None: the
            physics' period.
        noise: Standard deviation of each measurement's own error.
        bias: Error that is the same in all measurements.
        bias_deviation: Standard deviation of a further error that is drawn once, at the beginning
            and at each reset.
        random_walk: Standard deviation that a wandering error, 0 at first, has after 1 s; it grows
            with the square root of the time.
        delay: In s.
        jitter: The delay grows at each measurement by an amount drawn evenly between 0 and this,
            in s.
        interpolation: What was between two measurements: 0, what the earlier one saw; 1, what is
            on the line between them.
    """

    quantities: ClassVar[Mapping[str, int]] = {}
    """Number of components of each quantity, in the measurement's order."""
    exact: ClassVar[frozenset[str]] = frozenset()
    """Quantities without errors."""

    name: str
    period: float | None = None
    noise: Amounts = 0.0
    bias: Amounts = 0.0
    bias_deviation: Amounts = 0.0
    random_walk: Amounts = 0.0
    delay: float = 0.0
    jitter: float = 0.0
    interpolation: int = 0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: A value cannot be.
        """
        kind = type(self).__name__
        if not self.quantities:
            raise ConfigError(f"{kind} is no kind of sensor; use one of its subclasses.")
        if not isinstance(self.name, str) or not self.name:
            raise ConfigError(f"The name of a sensor is {self.name!r} but must be a text.")
        where = f'{kind} "{self.name}": '
        if self.period is not None:
            checks.positive(f"{where}period", self.period)
        checks.options(checks.not_negative, where, self, "delay", "jitter")
        if self.interpolation not in (0, 1):
            raise ConfigError(f"{where}interpolation is {self.interpolation!r}, not 0 or 1.")
        for option in ("noise", "bias", "bias_deviation", "random_walk"):
            for value in self.amounts(option):
                if option != "bias":
                    checks.not_negative(where + option, value)

    def amounts(self, option: str) -> list[float]:
        """Return ``"noise"`` or another error for each component, 3 for an orientation.

        Raises:
            ConfigError: A quantity does not exist or has no errors, or a value is no number.
        """
        given = getattr(self, option)
        where = f'{type(self).__name__} "{self.name}": {option}'
        widths = self.error_widths()
        if not isinstance(given, Mapping):
            return [checks.finite(where, given)] * sum(widths.values())
        unknown = [name for name in given if name not in widths]
        if unknown:
            raise UnknownOptionError(where, unknown, widths)
        found: list[float] = []
        for name, width in widths.items():
            value = given.get(name, 0.0)
            many = value if isinstance(value, (tuple, list)) else (value,) * width
            found += checks.vector(f'{where}["{name}"]', many, width)
        return found

    def error_widths(self) -> dict[str, int]:
        """Return how many errors each quantity has; those without are left out."""
        return {
            name: 3 if name == "orientation" else width
            for name, width in self.quantities.items()
            if name not in self.exact
        }


@dataclass(frozen=True, kw_only=True)
class Encoder(Sensor):
    """Measures a joint: ``position`` in rad or m, ``velocity`` in rad/s or m/s.

    Attributes:
        joint: Name of the joint in `Layout.joints`.
        reduction: Turns of what is measured for one of the joint, where it sits on a motor.
    """

    quantities: ClassVar[Mapping[str, int]] = {"position": 1, "velocity": 1}

    joint: str
    reduction: float = 1.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: A value cannot be.
        """
        super().__post_init__()
        if not checks.finite(f'Encoder "{self.name}": reduction', self.reduction):
            raise ConfigError(f'Encoder "{self.name}": reduction cannot be 0.')


@dataclass(frozen=True, kw_only=True)
class Imu(Sensor):
    """Measures how a place on a body moves, along the sensor's own axes.

    ``orientation``: quaternion x, y, z, w of the sensor in the world. ``angular_velocity`` in
    rad/s. ``acceleration`` in m/s², that of the last physics step, less that of free fall: at rest
    it points up.

    Attributes:
        body: Name of the link or object.
        position: Of the sensor in the body's frame, in m.
        rotation: Of the sensor in the body's frame: quaternion x, y, z, w.
    """

    quantities: ClassVar[Mapping[str, int]] = {
        "orientation": 4,
        "angular_velocity": 3,
        "acceleration": 3,
    }

    body: str
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    rotation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: A value cannot be.
        """
        super().__post_init__()
        where = f'Imu "{self.name}": '
        object.__setattr__(self, "position", checks.vector(f"{where}position", self.position, 3))
        rotation = checks.unit_quaternion(f"{where}rotation", self.rotation)
        object.__setattr__(self, "rotation", rotation)


@dataclass(frozen=True, kw_only=True)
class ContactSensor(Sensor):
    """Measures what touches a body, as of the last physics step.

    ``touching``: 1 or 0, without errors. ``normal_force``: sum of the contacts' forces along their
    normals, in N. ``force``: sum of all forces of contacts on the body, in N, in the world frame.

    Attributes:
        body: Name of the link or object.
    """

    quantities: ClassVar[Mapping[str, int]] = {"touching": 1, "normal_force": 1, "force": 3}
    exact: ClassVar[frozenset[str]] = frozenset({"touching"})

    body: str


@dataclass(frozen=True, kw_only=True)
class ForceTorqueSensor(Sensor):
    """Measures what a joint carries: ``force`` in N and ``torque`` in N m, of the last step.

    They act on the link behind the joint, at its origin and along its axes. Static loads, motion,
    contacts and wrenches all count. Needs an engine with the feature ``joint_wrenches``.

    Attributes:
        joint: Name of the joint in `Layout.joints`.
    """

    quantities: ClassVar[Mapping[str, int]] = {"force": 3, "torque": 3}

    joint: str


@dataclass(frozen=True, kw_only=True)
class EffortSensor(Sensor):
    """Measures the ``torque`` that drives a joint of the mode ``"force"``, in N m or N.

    Attributes:
        joint: Name of the joint in `Layout.joints`.
    """

    quantities: ClassVar[Mapping[str, int]] = {"torque": 1}

    joint: str
