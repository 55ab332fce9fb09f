"""Log: positions and torques of a robot's joints, from a file of any format that physx reads."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline

from physx_core.errors import UnknownOptionError, listed, nearest
from physx_core.typing import Array, Vector
from physx_identify.errors import IdentificationError
from physx_identify.estimation.base import Base, Imu
from physx_identify.estimation.equations import SLOWEST, Data
from physx_identify.logs.tables import read_table

_BASE = {"base_positions": ("x", "y", "z"), "base_orientations": ("qx", "qy", "qz", "qw")}
"""Components of a floating base's pose."""
_SENSOR = dict.fromkeys(("gyroscope", "accelerometer"), ("x", "y", "z"))
"""Components of an inertial sensor's readings."""
_OF_LINKS = {"wrench": 6, "force": 3, "moment": 3, "contact": 1}
"""What is of a link, and how many numbers it has."""
AXES = ("link", "world")
"""Along which axes wrenches may be."""
_MORE = {"positions": 7, "velocities": 6, "torques": 6}
"""Numbers of a floating base that may come before those of the joints."""
NAMES: Mapping[str, Sequence[str]] = {
    "time": ("time", "t", "timestamp", "stamp"),
    "positions": (
        *("positions", "position", "q", "qpos", "joint_positions", "joint_position", "state.q"),
        "observation.state",
    ),
    "velocities": (
        *("velocities", "velocity", "v", "dq", "qd", "qvel", "joint_velocities", "joint_velocity"),
        "state.v",
    ),
    "torques": (
        *("torques", "torque", "tau", "effort", "efforts", "joint_torques", "joint_torque"),
        *("motor.torque", "commands", "command", "u", "action"),
    ),
    "base_positions": ("base_positions", "base_position", "base_pos", "base"),
    "base_orientations": (
        *("base_orientations", "base_orientation", "base_quaternion", "base_quat", "base"),
    ),
    "gyroscope": ("gyroscope", "gyro", "imu.gyroscope", "imu.angular_velocity", "angular_velocity"),
    "accelerometer": (
        *("accelerometer", "accel", "imu.accelerometer", "imu.acceleration"),
        *("imu.linear_acceleration", "linear_acceleration"),
    ),
}
"""Names that columns have, by what they are."""
_NEEDED = ("positions", "torques")
_WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
_FACTORS = {
    "rad": 1.0, "deg": np.pi / 180, "degree": np.pi / 180, "°": np.pi / 180, "mrad": 1e-3,
    "m": 1.0, "mm": 1e-3, "cm": 1e-2, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9,
    "N m": 1.0, "Nm": 1.0, "N*m": 1.0, "mN m": 1e-3, "N mm": 1e-3, "kN m": 1e3, "N": 1.0, "kN": 1e3,
    "rad/s": 1.0, "deg/s": np.pi / 180, "°/s": np.pi / 180, "m/s": 1.0, "mm/s": 1e-3,
    "rpm": np.pi / 30, "m/s²": 1.0, "m/s^2": 1.0, "m/s2": 1.0, "g": 9.80665, "1": 1.0,
}  # fmt: skip
"""Units by their names, in rad, m, s, N m, N."""
_UNIT = 0.01
"""Largest deviation of a quaternion's length from 1."""
_EVEN = 0.01
"""Largest deviation of a time step, in steps, of a log that is not resampled."""


@dataclass(frozen=True)
class Log:
    """What was measured of a robot at equal intervals.

    Attributes:
        joints: Names of the joints; columns are in this order.
        period: Time between samples, in s.
        positions: Shape (samples, joints), in rad or m.
        torques: Measured or commanded, shape (samples, joints), in N m or N.
        velocities: Shape (samples, joints), in rad/s or m/s; None: not measured. They are compared
            with the positions, to notice wrong units, signs and orders, and not fitted.
        source: Where it comes from.
        left_out: Columns of the source that are none of these.
        base_positions: Of a floating base's frame in the world, shape (samples, 3), in m; None: the
            base is fixed.
        base_orientations: Its quaternions x, y, z, w, shape (samples, 4), of either sign.
        gyroscope: Angular velocity of a floating base along its own axes, shape (samples, 3), in
            rad/s; None: not measured.
        accelerometer: Specific force of a point on it along its axes, at rest 9.81 upwards, shape
            (samples, 3), in m/s². Both take the place of a pose that is None.
        arm: This point in the frame of the base, shape (3,), in m; None: its origin.
        wrenches: By the name of a link, the force and the moment from outside that act on it at its
            origin, shape (samples, 6), in N and N m. As in `physx_sim`, readings of forces and of
            inertial sensors are means over the period that ends with their sample.
        axes: Whether wrenches are along the axes of their ``"link"`` or of the ``"world"``.
        contacts: By the name of a link, 1 where something unknown touches it, else 0, shape
            (samples,). Torques that this enters are not used.

    Raises:
        IdentificationError: If shapes differ, a number is not finite, the period not positive, a
            quaternion not of length 1, a contact neither 0 nor 1, or there is half a pose or half
            an inertial sensor.
        UnknownOptionError: If there are no such axes.
    """

    joints: tuple[str, ...]
    period: float
    positions: Vector
    torques: Vector
    velocities: Vector | None = None
    source: str = "log"
    left_out: tuple[str, ...] = ()
    base_positions: Vector | None = None
    base_orientations: Vector | None = None
    gyroscope: Vector | None = None
    accelerometer: Vector | None = None
    arm: Vector | None = None
    wrenches: Mapping[str, Vector] = field(default_factory=dict)
    axes: str = "link"
    contacts: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.period > 0 or not np.isfinite(self.period):
            raise IdentificationError(f"{self.source}: the period is {self.period:g} s.")
        object.__setattr__(self, "joints", tuple(self.joints))
        if (self.base_positions is None) is not (self.base_orientations is None):
            raise IdentificationError(f"{self.source}: a base has a position and an orientation.")
        if (self.gyroscope is None) is not (self.accelerometer is None):
            raise IdentificationError(
                f"{self.source}: an inertial sensor has a gyroscope and an accelerometer."
            )
        if self.axes not in AXES:
            raise UnknownOptionError("axes", [str(self.axes)], AXES)
        parts = dict.fromkeys(("positions", "torques", "velocities"), self.joints)
        for name, columns in (parts | _BASE | _SENSOR).items():
            if (given := getattr(self, name)) is not None:
                values = self._checked(name, given, columns)
                if name == "base_orientations":
                    values = _continued(self.source, values)
                values.flags.writeable = False
                object.__setattr__(self, name, values)
        wrenches = {
            link: self._checked(f"wrenches of {link}", values, _WRENCH)
            for link, values in self.wrenches.items()
        }
        contacts = {link: self._flags(link, each) for link, each in self.contacts.items()}
        object.__setattr__(self, "wrenches", wrenches)
        object.__setattr__(self, "contacts", contacts)

    def _checked(self, name: str, given: Vector, columns: Sequence[str]) -> Vector:
        """Return a copy of values, shape (samples, columns)."""
        values = np.array(given, np.float64)
        if values.ndim != 2 or values.shape != (len(self.positions), len(columns)):
            raise IdentificationError(
                f"{self.source}: {name} have the shape {values.shape} instead of "
                f"({len(self.positions)}, {len(columns)}): samples, {', '.join(columns)}."
            )
        wrong = np.argwhere(~np.isfinite(values))
        if len(wrong):
            row, column = wrong[0]
            raise IdentificationError(
                f"{self.source}: {name} of {columns[column]} are {values[row, column]} in "
                f"row {row}; {len(wrong)} numbers are not finite. Cut the log there."
            )
        return values

    def _flags(self, link: str, given: Vector) -> Array:
        values = self._checked(f"contacts of {link}", np.reshape(given, (-1, 1)), ("on",))[:, 0]
        wrong = np.flatnonzero((values != 0) & (values != 1))
        if len(wrong):
            raise IdentificationError(
                f"{self.source}: the contact of {link} is {values[wrong[0]]:g} in row {wrong[0]}, "
                f"neither 0 nor 1. If it is a force, name it so: force.{link}."
            )
        on: Array = values == 1
        return on

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def base(self) -> Base | Imu | None:
        """What is known of a floating base, by its pose if there is one; None: it is fixed."""
        if self.base_orientations is not None:
            return Base.of(self.base_orientations)
        if self.gyroscope is None:
            return None
        return Imu(np.zeros(3) if self.arm is None else np.array(self.arm))

    @property
    def coordinates(self) -> Vector:
        """Positions of base and joints, as of `Path`, shape (samples, coordinates)."""
        parts = [self.positions]
        if self.base_orientations is not None and self.base_positions is not None:
            parts = [self.base_positions, Base.of(self.base_orientations).angles, self.positions]
        elif self.gyroscope is not None and self.accelerometer is not None:
            parts = [self.accelerometer, self.gyroscope, self.positions]
        found: Vector = np.concatenate(parts, axis=1)
        return found

    def with_sensor_at(self, pose: Vector) -> Log:
        """Return the log whose inertial sensor has another pose, in place of the base's pose.

        Args:
            pose: Of the sensor in the frame of the base, a homogeneous matrix of shape (4, 4).

        Raises:
            IdentificationError: If there are no readings of an inertial sensor.
        """
        if self.gyroscope is None or self.accelerometer is None:
            raise IdentificationError(
                f"{self.source} has no readings of an inertial sensor: gyroscope (angular "
                "velocity) and accelerometer, each x, y, z. Leave imu out (--imu)."
            )
        turn = pose[:3, :3].T
        return replace(
            self,
            base_positions=None,
            base_orientations=None,
            gyroscope=self.gyroscope @ turn,
            accelerometer=self.accelerometer @ turn,
            arm=pose[:3, 3],
        )

    def check_no_contacts(self, what: str) -> None:
        """Check that nothing touches the robot, as something needs.

        Raises:
            IdentificationError: If there are wrenches or contacts.
        """
        if self.wrenches or self.contacts:
            raise IdentificationError(
                f"{what} know nothing of contacts, but {self.source} has such of "
                f"{listed([*self.wrenches, *self.contacts])}. Leave them out."
            )


def data_of(
    log: Log, instant: bool = False, slowest: float = SLOWEST, flight: bool = False
) -> Data:
    """Return what is fitted of a log; options are those of `Data`."""
    coordinates = log.coordinates
    base = coordinates.shape[1] - len(log.joints)
    torques = np.pad(log.torques, ((0, 0), (base, 0)))
    return Data(
        coordinates, torques, log.period, instant, slowest, log.base, flight, log.wrenches,
        log.axes, log.contacts,
    )  # fmt: skip


def _continued(source: str, quaternions: Vector) -> Vector:
    """Return unit quaternions of a sign that does not change from one to the next."""
    lengths = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1) > _UNIT)
    if len(wrong):
        raise IdentificationError(
            f"{source}: the base's quaternion has the length {lengths[wrong[0]]:.4g} in row "
            f"{wrong[0]} instead of 1 (x, y, z, w)."
        )
    unit = quaternions / lengths[:, None]
    turned = np.sum(unit[1:] * unit[:-1], axis=1) < 0
    unit[1:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
    found: Vector = unit
    return found


def read_log(
    path: str | Path,
    joints: Sequence[str],
    *,
    period: float | None = None,
    columns: Mapping[str, str] | None = None,
    episode: int | None = None,
    topic: str | None = None,
    floating: bool = False,
    axes: str = "link",
) -> Log:
    """Read a log.

    A column is found by its usual names, such as ``q``, ``tau`` and ``time``, as an array with a
    number for each joint in order, or as one column a joint: ``q.elbow``, ``q_elbow``,
    ``robot.elbow``. Units in the file are converted. What acts on a link is found by its name:
    ``force.foot`` and ``moment.foot``, each an array of three or a column a component, such as
    ``force.foot_x``; both as ``wrench.foot``, six numbers; or ``contact.foot``, 1 or 0.

    Args:
        path: A file or folder of a format that physx imports (CSV, Parquet, npz, HDF5,
            safetensors, MCAP), a physx dataset, an episode's log, or the folder of a LeRobot
            dataset.
        joints: Names of the joints, in the order of arrays.
        period: Time between samples, in s; None: from the column of times.
        columns: Name of the column of ``"time"``, ``"positions"``, ``"velocities"``, ``"torques"``,
            ``"gyroscope"``, ``"accelerometer"`` or, say, ``"force.foot"``, where it is not the
            usual one.
        episode: Which episode of a dataset with the column ``episode`` or ``episode_index``; None:
            the only one.
        topic: Topic of an MCAP file, or group of an HDF5 file, that has the columns; None: the only
            one of all joints.
        floating: Whether the base floats, so that its pose is needed: ``base_x`` to ``base_z`` and
            ``base_qx`` to ``base_qw``, arrays of them, or seven numbers before the positions; or
            the readings of an inertial sensor on it: ``gyroscope`` and ``accelerometer``, arrays of
            three, or ``gyroscope_x`` ...
        axes: As in `Log`.

    Raises:
        IdentificationError: If columns are missing, not of these joints or in an unknown unit; if
            there is no time, it does not increase or has gaps; or if there are several episodes or
            topics.
        ExchangeError: If the file cannot be read.
        UnknownOptionError: If there are no such axes.
    """
    path = Path(path)
    given = dict(columns or {})
    wrong = [name for name in given if name not in NAMES and not _is_of_link(name)]
    if wrong:
        known = [*NAMES, *(f"{kind}.LINK" for kind in _OF_LINKS)]
        raise IdentificationError(f'There is no column "{wrong[0]}" to choose: {listed(known)}.')
    table, units = read_table(path, joints, episode, topic, given.values())
    used: set[str] = set()
    moving = {**_BASE, **_SENSOR}
    names = [name for name in NAMES if floating or name not in moving]
    found = {
        name: values
        for name in names
        if (values := _find(path, table, units, name, given.get(name), joints, used, floating))
        is not None
    }
    if floating:
        _split(found, len(joints))
    sensor = any(name in found for name in _SENSOR)
    base = () if not floating else _SENSOR if sensor and not found.keys() & _BASE else _BASE
    for name in (*_NEEDED, *base):
        if name not in found:
            parts = moving.get(name, joints)
            raise IdentificationError(
                f"{path} has no column of {name} ({listed(parts)}). It has: {listed(table)}. Name "
                f"it with columns (--columns {name}=NAME)."
            )
    if "base_orientations" in found:
        found["base_orientations"] = _continued(str(path), found["base_orientations"])
    if not all(name in found for name in _SENSOR):
        found = {name: values for name, values in found.items() if name not in _SENSOR}
    wrenches, contacts = _of_links(path, table, units, given, used)
    left_out = tuple(name for name in table if name not in used)
    time = found.pop("time", None)
    if period is None:
        if time is None:
            raise IdentificationError(
                f"{path} has no column of times. Give the time between samples: period (--period)."
            )
        period, even = _even(path, time[:, 0])
        found = {name: even(values, name) for name, values in found.items()}
        wrenches, contacts = (
            {link: even(values, kind) for link, values in each.items()}
            for kind, each in (("wrench", wrenches), ("contact", contacts))
        )
    return Log(
        tuple(joints), period, source=str(path), left_out=left_out, axes=axes, wrenches=wrenches,
        contacts=contacts, **found,
    )  # fmt: skip


def _split(found: dict[str, Vector], joints: int) -> None:
    """Take the numbers of a floating base out of those before the joints'."""
    positions = found.get("positions")
    if positions is not None and positions.shape[1] > joints:
        found.setdefault("base_positions", positions[:, :3])
        found.setdefault("base_orientations", positions[:, 3:7])
    for name in _MORE:
        if name in found:
            found[name] = found[name][:, -joints:]


def _find(
    path: Path,
    table: Mapping[str, Vector],
    units: Mapping[str, str],
    kind: str,
    given: str | None,
    joints: Sequence[str],
    used: set[str],
    floating: bool,
) -> Vector | None:
    """Return what is of a kind, shape (rows, joints), in the units of `Log`."""
    joints = {**_BASE, **_SENSOR}.get(kind, joints)
    width = 1 if kind == "time" else len(joints)
    wide = width + (_MORE.get(kind, 0) if floating else 0)
    names = NAMES[kind] if given is None else (given,)
    for name in names:
        if name in table:
            values = table[name]
            if values.shape[1] not in (width, wide):
                if given is None and kind == "time":
                    continue
                raise IdentificationError(
                    f'{path}: "{name}" has {values.shape[1]} numbers a row, but there are {width}: '
                    f"{listed(joints)}."
                )
            used.add(name)
            return values * _factors(path, name, units.get(name, ""), values.shape[1])
        if kind != "time":
            columns = [_of_joint(table, name, joint) for joint in joints]
            if all(columns):
                used.update(filter(None, columns))
                factors = [_factors(path, c, units.get(c, ""), 1) for c in columns if c]
                return np.column_stack([table[c] for c in columns if c]) * np.concatenate(factors)
            if any(columns):
                missing = joints[columns.index(None)]
                near = nearest(f"{name}.{missing}", table)
                raise IdentificationError(
                    f'{path}: {kind} of the joint "{missing}" are missing.{near}'
                )
    if given is not None:
        raise IdentificationError(
            f'{path} has no column "{given}".{nearest(given, table)} It has: {listed(table)}.'
        )
    return None


def _of_joint(table: Mapping[str, Vector], name: str, joint: str) -> str | None:
    for column in table:
        begins = column.startswith((f"{name}.", f"{name}_", f"{name}/"))
        if begins and column.endswith((f".{joint}", f"_{joint}", f"/{joint}")):
            return column
    return None


def _factors(path: Path, name: str, unit: str, width: int) -> Vector:
    own = [each.strip() for each in unit.split(",")] if "," in unit else [unit.strip()] * width
    if len(own) != width:
        own = [own[0]] * width
    for each in own:
        if each and each not in _FACTORS:
            raise IdentificationError(
                f'{path}: the unit "{each}" of "{name}" is not known: {listed(_FACTORS)}.'
            )
    return np.array([_FACTORS.get(each, 1.0) if each else 1.0 for each in own])


def _is_of_link(name: str) -> bool:
    kind, _, link = name.partition(".")
    return kind in _OF_LINKS and bool(link)


def _of_links(
    path: Path,
    table: Mapping[str, Vector],
    units: Mapping[str, str],
    given: Mapping[str, str],
    used: set[str],
) -> tuple[dict[str, Vector], dict[str, Vector]]:
    """Return wrenches and contacts by link, shapes (rows, 6) and (rows,)."""
    named = {name: name for name in table if _is_of_link(name) and name not in used}
    for name, column in given.items():
        if _is_of_link(name):
            parts = [f"_{part}" for part in "xyz" if f"{column}_{part}" in table]
            ends = [""] if column in table or not parts else parts
            named |= {name + end: column + end for end in ends}
    wrenches: dict[str, Vector] = {}
    contacts: dict[str, Vector] = {}
    for name, column in named.items():
        if column not in table:
            raise IdentificationError(
                f'{path} has no column "{column}".{nearest(column, table)} It has: {listed(table)}.'
            )
        kind, _, link = name.partition(".")
        values, width = table[column], _OF_LINKS[kind]
        first, part = 3 * (kind == "moment"), "xyz".find(link[-1:])
        if values.shape[1] == 1 < width and link[-2:-1] in ("_", ".") and part >= 0:
            link, first, width = link[:-2], first + part, 1
        if values.shape[1] != width:
            raise IdentificationError(
                f'{path}: "{column}" has {values.shape[1]} numbers a row, but a {kind} has {width}.'
            )
        used.add(column)
        values = values * _factors(path, column, units.get(column, ""), width)
        if kind == "contact":
            contacts[link] = values[:, 0]
        else:
            own = wrenches.setdefault(link, np.full((len(values), 6), np.nan))
            own[:, first : first + width] = values
    for link, own in wrenches.items():
        known = ~np.all(np.isnan(own), axis=0)
        if not known[:3].all() or (known[3:].any() and not known[3:].all()):
            missing = _WRENCH[int(np.argmin(known))]
            raise IdentificationError(
                f"{path}: of what acts on {link}, {missing} is missing (force.{link}: x, y, z; "
                f"moment.{link}: x, y, z, or none of it)."
            )
        own[:, ~known] = 0.0
    return wrenches, contacts


def _even(path: Path, time: Vector) -> tuple[float, Callable[[Vector, str], Vector]]:
    """Return the period, and what takes values of a kind to equal intervals."""
    steps = np.diff(time)
    if len(steps) < 2:
        raise IdentificationError(f"{path} has {len(time)} samples, too few for anything.")
    if not (steps > 0).all():
        row = int(np.argmin(steps))
        raise IdentificationError(
            f"{path}: time does not increase: it is {time[row]:g} s, then {time[row + 1]:g} s, in "
            f"row {row + 1}."
        )
    period = float(np.median(steps))
    worst = int(np.argmax(steps))
    if steps[worst] > 1.5 * period:
        raise IdentificationError(
            f"{path} has a gap of {steps[worst]:.4g} s after {time[worst]:.4g} s, where samples "
            f"are {period:.4g} s apart. Cut the log there."
        )
    if np.abs(steps - period).max() <= _EVEN * period:
        return float((time[-1] - time[0]) / len(steps)), lambda values, _: values
    even = np.arange(time[0], time[-1], period)

    def resampled(values: Vector, kind: str) -> Vector:
        straight = kind in _OF_LINKS  # forces jump
        found: Vector = make_interp_spline(time, values, 1 if straight else 3)(even)
        return np.ceil(found - _EVEN) if kind == "contact" else found

    return period, resampled
