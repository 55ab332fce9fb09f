"""Log: positions and torques of a robot's joints, from a file of any format that physx reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physx_core.errors import listed, nearest
from physx_core.typing import Vector
from physx_identify.errors import IdentificationError
from physx_identify.estimation.base import Base
from physx_identify.logs.tables import read_table

_BASE = {"base_positions": ("x", "y", "z"), "base_orientations": ("qx", "qy", "qz", "qw")}
"""Components of a floating base's pose."""
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
}
"""Names that columns have, by what they are."""
_NEEDED = ("positions", "torques")
_FACTORS = {
    "rad": 1.0, "deg": np.pi / 180, "degree": np.pi / 180, "°": np.pi / 180, "mrad": 1e-3,
    "m": 1.0, "mm": 1e-3, "cm": 1e-2, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9,
    "N m": 1.0, "Nm": 1.0, "N*m": 1.0, "mN m": 1e-3, "N mm": 1e-3, "kN m": 1e3, "N": 1.0, "kN": 1e3,
    "rad/s": 1.0, "deg/s": np.pi / 180, "°/s": np.pi / 180, "m/s": 1.0, "mm/s": 1e-3,
    "rpm": np.pi / 30, "1": 1.0,
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

    Raises:
        IdentificationError: If shapes differ, a number is not finite, the period not positive, or a
            quaternion not of length 1.
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

    def __post_init__(self) -> None:
        if not self.period > 0 or not np.isfinite(self.period):
            raise IdentificationError(f"{self.source}: the period is {self.period:g} s.")
        object.__setattr__(self, "joints", tuple(self.joints))
        if (self.base_positions is None) is not (self.base_orientations is None):
            raise IdentificationError(f"{self.source}: a base has a position and an orientation.")
        parts = dict.fromkeys(("positions", "torques", "velocities"), self.joints) | _BASE
        for name, columns in parts.items():
            given = getattr(self, name)
            if given is None:
                continue
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
            if name == "base_orientations":
                values = _continued(self.source, values)
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def base(self) -> Base | None:
        """Motion of a floating base; None: it is fixed."""
        return None if self.base_orientations is None else Base.of(self.base_orientations)

    @property
    def coordinates(self) -> Vector:
        """Positions of base and joints, as of `Model.coordinates`, in rad or m."""
        base = self.base
        if base is None or self.base_positions is None:
            return self.positions
        found: Vector = np.concatenate([self.base_positions, base.angles, self.positions], axis=1)
        return found


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
) -> Log:
    """Read a log.

    A column is found by its usual names, such as ``q``, ``tau`` and ``time``, as an array with a
    number for each joint in order, or as one column a joint: ``q.elbow``, ``q_elbow``,
    ``robot.elbow``. Units in the file are converted.

    Args:
        path: A file or folder of a format that physx imports (CSV, Parquet, npz, HDF5,
            safetensors, MCAP), a physx dataset, an episode's log, or the folder of a LeRobot
            dataset.
        joints: Names of the joints, in the order of arrays.
        period: Time between samples, in s; None: from the column of times.
        columns: Name of the column of ``"time"``, ``"positions"``, ``"velocities"`` or
            ``"torques"``, where it is not the usual one.
        episode: Which episode of a dataset with the column ``episode`` or ``episode_index``; None:
            the only one.
        topic: Topic of an MCAP file, or group of an HDF5 file, that has the columns; None: the only
            one of all joints.
        floating: Whether the base floats, so that its pose is needed: ``base_x`` to ``base_z`` and
            ``base_qx`` to ``base_qw``, arrays of them, or seven numbers before the positions.

    Raises:
        IdentificationError: If columns are missing, not of these joints or in an unknown unit; if
            there is no time, it does not increase or has gaps; or if there are several episodes or
            topics.
        ExchangeError: If the file cannot be read.
    """
    path = Path(path)
    given = dict(columns or {})
    wrong = [name for name in given if name not in NAMES]
    if wrong:
        raise IdentificationError(f'There is no column "{wrong[0]}" to choose: {listed(NAMES)}.')
    table, units = read_table(path, joints, episode, topic, given.values())
    used: set[str] = set()
    names = [name for name in NAMES if floating or name not in _BASE]
    found = {
        name: values
        for name in names
        if (values := _find(path, table, units, name, given.get(name), joints, used, floating))
        is not None
    }
    if floating:
        _split(found, len(joints))
    for name in names if floating else _NEEDED:
        if name not in found and name not in ("time", "velocities"):
            parts = _BASE.get(name, joints)
            raise IdentificationError(
                f"{path} has no column of {name} ({listed(parts)}). It has: {listed(table)}. Name "
                f"it with columns (--columns {name}=NAME)."
            )
    if floating:
        found["base_orientations"] = _continued(str(path), found["base_orientations"])
    left_out = tuple(name for name in table if name not in used)
    time = found.pop("time", None)
    if period is None:
        if time is None:
            raise IdentificationError(
                f"{path} has no column of times. Give the time between samples: period (--period)."
            )
        period, series = _even(path, time[:, 0], list(found.values()))
        found = dict(zip(found, series, strict=True))
    return Log(tuple(joints), period, source=str(path), left_out=left_out, **found)


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
    joints = _BASE.get(kind, joints)
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


def _even(path: Path, time: Vector, values: list[Vector]) -> tuple[float, list[Vector]]:
    """Return the period and values at equal intervals."""
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
        return float((time[-1] - time[0]) / len(steps)), values
    even = np.arange(time[0], time[-1], period)
    from scipy.interpolate import CubicSpline

    return period, [CubicSpline(time, each)(even) for each in values]
