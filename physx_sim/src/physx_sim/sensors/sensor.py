"""Descriptions of sensors: plain, picklable data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from physx_core import checks
from physx_core.errors import ConfigError, UnknownOptionError

_IMAGES = {"depth": 2, "segmentation": 2, "rgb": 3}
"""Images of cameras, and how many axes they have."""
_MOST_PIXELS = 4096
"""Largest number of rows and of columns of an image."""
Amounts = float | Mapping[str, float | Sequence[float]]
"""A number for all components, or for each quantity one number or a number for each component."""


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Options common to all sensors.

    A measurement is the ideal value from `delay` plus a random fraction of `jitter` ago, plus bias,
    random walk, and noise. Errors are in the units of the quantity; those of an orientation are
    small rotations about the sensor's own axes, in rad.

    Attributes:
        name: Name of the sensor.
        period: Time between two measurements, in s; a multiple of the physics period; None: the
            physics period.
        noise: Standard deviation of the white noise of each measurement.
        bias: Constant error.
        bias_deviation: Standard deviation of an additional constant error, drawn at the start and
            at each reset.
        random_walk: Standard deviation of the random walk after 1 s; it starts at 0 and grows with
            the square root of time.
        delay: Delay of each measurement, in s.
        jitter: Largest random addition to the delay, drawn uniformly for each measurement, in s.
        interpolation: Value between two measurements: 0, the earlier one; 1, linear interpolation.

    Raises:
        ConfigError: If it is not of a subclass, its name is empty, or an option is out of range.
    """

    quantities: ClassVar[Mapping[str, int]] = {}
    """Number of components of each quantity, in the measurement's order; some sensors choose it."""
    exact: ClassVar[frozenset[str]] = frozenset()
    """Quantities that have no errors."""

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
        kind = type(self).__name__
        if not self.quantities:
            raise ConfigError(f"{kind} is not a kind of sensor; use one of its subclasses.")
        if not isinstance(self.name, str) or not self.name:
            raise ConfigError(
                f"The name of a sensor is {self.name!r} but must be a nonempty string."
            )
        where = f'{kind} "{self.name}": '
        checks.store_declared(where, self)
        if self.period is not None:
            checks.positive(f"{where}period", self.period)
        checks.options(checks.not_negative, where, self, "delay", "jitter")
        if self.interpolation not in (0, 1):
            raise ConfigError(f"{where}interpolation is {self.interpolation!r} but must be 0 or 1.")
        for option in ("noise", "bias", "bias_deviation", "random_walk"):
            for value in self.amounts(option):
                if option != "bias":
                    checks.not_negative(where + option, value)

    def amounts(self, option: str) -> list[float]:
        """Return the amounts of an error, such as ``"noise"``, by component; 3 for an orientation.

        Raises:
            ConfigError: If a quantity does not exist or has no errors, or a value is not a number.
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

    def shape_of(self, quantity: str) -> tuple[int, ...]:
        """Return the shape of a quantity in the sensor's record: () for a number.

        Args:
            quantity: Its name.
        """
        width = self.quantities[quantity]
        return () if width == 1 else (width,)

    def error_widths(self) -> dict[str, int]:
        """Return the number of errors of each quantity that has errors."""
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
        reduction: Turns of the measured shaft per joint turn, for an encoder on the motor.

    Raises:
        ConfigError: If an option is out of range, or `reduction` is 0.
    """

    quantities: ClassVar[Mapping[str, int]] = {"position": 1, "velocity": 1}

    joint: str
    reduction: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not checks.finite(f'Encoder "{self.name}": reduction', self.reduction):
            raise ConfigError(f'Encoder "{self.name}": reduction must not be 0.')


@dataclass(frozen=True, kw_only=True)
class Imu(Sensor):
    """Measures the motion of a point on a body, along the sensor's own axes.

    ``orientation``: quaternion x, y, z, w of the sensor in the world. ``angular_velocity`` in
    rad/s. ``acceleration`` (specific force) of the last physics step in m/s²: at rest it points
    up.

    Attributes:
        body: Name of the link or object.
        position: Position of the sensor in the body's frame, in m.
        rotation: Rotation of the sensor in the body's frame: quaternion x, y, z, w.
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
        super().__post_init__()
        where = f'Imu "{self.name}": '
        object.__setattr__(self, "position", checks.vector(f"{where}position", self.position, 3))
        rotation = checks.unit_quaternion(f"{where}rotation", self.rotation)
        object.__setattr__(self, "rotation", rotation)


@dataclass(frozen=True, kw_only=True)
class ContactSensor(Sensor):
    """Measures the contacts of a body in the last physics step.

    ``touching``: 1 or 0, without errors. ``normal_force``: sum of the contact forces along their
    normals, in N. ``force``: sum of all contact forces on the body, in N, in the world frame.

    Attributes:
        body: Name of the link or object.
    """

    quantities: ClassVar[Mapping[str, int]] = {"touching": 1, "normal_force": 1, "force": 3}
    exact: ClassVar[frozenset[str]] = frozenset({"touching"})

    body: str


@dataclass(frozen=True, kw_only=True)
class ForceTorqueSensor(Sensor):
    """Measures the reaction of a joint in the last step: ``force`` in N and ``torque`` in N m.

    They act on the joint's child link, at its origin and in its frame. Static loads, motion,
    contacts, and wrenches are all included. Needs an engine with the feature ``joint_wrenches``.

    Attributes:
        joint: Name of the joint in `Layout.joints`.
        link: Instead, the name of the child link, as in `Layout.bodies`, of any joint: a fixed one,
            such as that of a gripper or a tool, too.

    Raises:
        ConfigError: If not exactly one of both is given, or another option is out of range.
    """

    quantities: ClassVar[Mapping[str, int]] = {"force": 3, "torque": 3}

    joint: str = ""
    link: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if bool(self.joint) == bool(self.link):
            raise ConfigError(f'ForceTorqueSensor "{self.name}" needs a joint or a link.')


@dataclass(frozen=True, kw_only=True)
class EffortSensor(Sensor):
    """Measures the ``torque`` that drives a joint in ``"force"`` mode, in N m or N.

    Attributes:
        joint: Name of the joint in `Layout.joints`.
    """

    quantities: ClassVar[Mapping[str, int]] = {"torque": 1}

    joint: str


@dataclass(frozen=True, kw_only=True)
class RaySensor(Sensor):
    """Options common to `Lidar`, `HeightScan` and `Camera`, which see shapes and the ground.

    Attributes:
        body: Name of the link or object that carries it, whose own shapes it does not see.
        reach: How far it sees, in m.
        ignored: Names of other bodies that it does not see.

    Raises:
        ConfigError: If an option is out of range, or `ignored` are not names.
    """

    body: str
    reach: float = 10.0
    ignored: Sequence[str] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        where = f'{type(self).__name__} "{self.name}": '
        checks.positive(f"{where}reach", self.reach)
        object.__setattr__(self, "ignored", checks.names(f"{where}ignored", self.ignored))

    def _store_rows(self, option: str, width: int) -> None:
        where, rows = f'{type(self).__name__} "{self.name}": {option}', getattr(self, option)
        try:
            found = tuple(checks.vector(where, row, width) for row in rows)
        except TypeError:
            found = ()
        if not found:
            raise ConfigError(f"{where} is {rows!r} but must be rows of {width} numbers.")
        object.__setattr__(self, option, found)


@dataclass(frozen=True, kw_only=True)
class Lidar(RaySensor):
    """Measures ``distances`` along rays, in m; `reach` where nothing is hit.

    Attributes:
        directions: Directions of the rays in the sensor's frame, of any length: see `fan`.
        position: Position of the sensor in the body's frame, in m.
        rotation: Rotation of the sensor in the body's frame: quaternion x, y, z, w.

    Raises:
        ConfigError: If a direction is 0, or another option is out of range.
    """

    directions: Sequence[tuple[float, ...]]
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    rotation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)

    @property
    def quantities(self) -> Mapping[str, int]:  # type: ignore[override]
        """Number of components of each quantity."""
        return {"distances": len(self.directions)}

    def __post_init__(self) -> None:
        self._store_rows("directions", 3)
        super().__post_init__()
        where = f'Lidar "{self.name}": '
        lengths = [math.hypot(*direction) for direction in self.directions]
        if not min(lengths) > 0:
            raise ConfigError(f"{where}a direction is 0.")
        scaled = zip(self.directions, lengths, strict=True)
        unit = tuple(checks.scaled(direction, length) for direction, length in scaled)
        object.__setattr__(self, "directions", unit)
        object.__setattr__(self, "position", checks.vector(f"{where}position", self.position, 3))
        rotation = checks.unit_quaternion(f"{where}rotation", self.rotation)
        object.__setattr__(self, "rotation", rotation)


@dataclass(frozen=True, kw_only=True)
class HeightScan(RaySensor):
    """Measures ``heights`` of what is below points around a body, relative to its origin, in m.

    The points turn with the body's heading, but not with its roll and pitch. Rays go down from
    `reach` above the body to `reach` below it; where they hit nothing, the height is -`reach`.

    Attributes:
        points: x and y of the points, in m: ahead of the body and to its left.
    """

    points: Sequence[tuple[float, ...]]

    @property
    def quantities(self) -> Mapping[str, int]:  # type: ignore[override]
        """Number of components of each quantity."""
        return {"heights": len(self.points)}

    def __post_init__(self) -> None:
        self._store_rows("points", 2)
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class Camera(RaySensor):
    """Takes images along its x axis; z points up in them, and y to the left.

    ``depth``: distance along x of what is seen, in m; `reach` where nothing is. ``segmentation``:
    the body that is seen, an index into `Layout.names`, or -1, without errors. ``rgb``: colors from
    0 to 255; each body has one. Rows are from the top down, columns from left to right. Needs an
    engine with the feature ``cameras``.

    Attributes:
        body: As for all ray sensors; empty: the camera stands in the world.
        images: Which of these images it takes.
        height: Number of rows.
        width: Number of columns; pixels are squares.
        field_of_view: Angle between the upper and the lower edge of the images, in rad.
        near: Distance below which nothing is seen, in m.
        position: Position of the sensor in the body's frame, in m.
        rotation: Rotation of the sensor in the body's frame: quaternion x, y, z, w.

    Raises:
        UnknownOptionError: If there is no such image.
        ConfigError: If no image is named, or another option is out of range.
    """

    exact: ClassVar[frozenset[str]] = frozenset({"segmentation"})

    body: str = ""
    images: Sequence[str] = ("depth",)
    height: int = 64
    width: int = 64
    field_of_view: float = 1.0
    near: float = 0.01
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    rotation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)

    @property
    def quantities(self) -> Mapping[str, int]:  # type: ignore[override]
        """Number of components of each quantity."""
        return {image: math.prod(self.shape_of(image)) for image in self.images}

    def shape_of(self, quantity: str) -> tuple[int, ...]:
        """Return the shape of an image: (height, width), with 3 colors for ``rgb``.

        Args:
            quantity: Its name.
        """
        return (self.height, self.width, 3)[: _IMAGES.get(quantity, 2)]

    def __post_init__(self) -> None:
        where = f'Camera "{self.name}": '
        images = self.images
        images = (images,) if isinstance(images, str) else checks.names(f"{where}images", images)
        if unknown := [str(image) for image in images if image not in _IMAGES]:
            raise UnknownOptionError(f"{where}images", unknown, tuple(_IMAGES))
        object.__setattr__(self, "images", tuple(dict.fromkeys(images)))
        if not images:
            raise ConfigError(f"{where}images are none, but must be of: {', '.join(_IMAGES)}.")
        checks.store_declared(where, self)
        for option in ("height", "width"):
            if not 0 < (value := getattr(self, option)) <= _MOST_PIXELS:
                raise ConfigError(f"{where}{option} is {value!r}, not from 1 to {_MOST_PIXELS}.")
        super().__post_init__()
        if not 0 < self.field_of_view < math.pi:
            raise ConfigError(
                f"{where}field_of_view is {self.field_of_view!r} but must be between 0 and π."
            )
        if not 0 < self.near < self.reach:
            raise ConfigError(f"{where}near is {self.near!r} but must be between 0 and reach.")
        object.__setattr__(self, "position", checks.vector(f"{where}position", self.position, 3))
        rotation = checks.unit_quaternion(f"{where}rotation", self.rotation)
        object.__setattr__(self, "rotation", rotation)


def fan(
    azimuths: Sequence[float], elevations: Sequence[float] = (0.0,)
) -> list[tuple[float, float, float]]:
    """Return the directions of a lidar's rays: of each elevation at each azimuth.

    Args:
        azimuths: Angles about z, from x, in rad.
        elevations: Angles above the xy plane, in rad.
    """
    return [
        (math.cos(up) * math.cos(turn), math.cos(up) * math.sin(turn), math.sin(up))
        for up in elevations
        for turn in azimuths
    ]
