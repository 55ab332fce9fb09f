"""Motions of a robot over time, to follow or to replay."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from physx_core import checks
from physx_core.errors import ConfigError
from physx_core.fields import is_finite
from physx_core.rotations import interpolate_rows
from physx_core.typing import Vector
from physx_gym.errors import LogError

Beyond = Literal["raise", "wrap", "clip"]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The motion of a robot, or of everything in a world.

    Positions and velocities are interpolated linearly between two rows, quaternions along the
    shorter arc.

    Attributes:
        times: Non-decreasing, shape (rows,), in s; like the others kept as a read-only copy.
        positions: Shape (rows, nq), in the convention of `physx_sim.layout`.
        velocities: Shape (rows, nv), likewise.
        beyond: What happens before the first and after the last row: ``"raise"``, an error;
            ``"wrap"``, the motion repeats from where it ended on the ground; ``"clip"``, the first
            or last row holds.
    """

    times: Vector
    positions: Vector
    velocities: Vector
    beyond: Beyond = "raise"

    def __post_init__(self) -> None:
        """Check that the arrays fit together.

        Raises:
            ConfigError: If they do not.
        """
        checks.store_declared("Trajectory.", self)
        rows = len(np.atleast_1d(self.times))
        shapes = [np.shape(a) for a in (self.times, self.positions, self.velocities)]
        if len(shapes[0]) != 1 or not rows or any(len(s) != 2 or s[0] != rows for s in shapes[1:]):
            raise ConfigError(
                "A trajectory needs times (rows,), positions (rows, nq) and velocities (rows, nv), "
                f"not {shapes}."
            )
        if not all(is_finite(np.asarray(a)) for a in (self.times, self.positions, self.velocities)):
            raise ConfigError("The values of a trajectory must be finite.")
        if (np.diff(self.times) < 0).any():
            raise ConfigError("The times of a trajectory must not decrease.")
        if self.beyond not in ("raise", "wrap", "clip"):
            raise ConfigError(f'beyond is "{self.beyond}", not "raise", "wrap" or "clip".')

    @property
    def duration(self) -> float:
        """Time from the first to the last row, in s."""
        return float(self.times[-1] - self.times[0])

    def at(self, t: float) -> tuple[Vector, Vector]:
        """Return positions (nq,) and velocities (nv,) at a time, in s.

        Raises:
            ConfigError: If the time is outside the trajectory and `beyond` is ``"raise"``, or if
                there is more than one floating base in the positions.
        """
        first, last = float(self.times[0]), float(self.times[-1])
        laps = 0
        if self.beyond == "wrap" and self.duration > 0:
            laps = int((t - first) // self.duration)
            t -= laps * self.duration
        elif self.beyond == "raise" and not first - 1e-9 <= t <= last + 1e-9:
            raise ConfigError(
                f"The trajectory is from {first:g} s to {last:g} s, but {t:g} s was requested: "
                'choose beyond="clip" or "wrap".'
            )
        t = min(max(t, first), last)
        row = min(max(int(np.searchsorted(self.times, t, "right")) - 1, 0), len(self.times) - 1)
        after = min(row + 1, len(self.times) - 1)
        span = float(self.times[after] - self.times[row])
        share = (t - float(self.times[row])) / span if span > 0 else 0.0
        q = _interpolate(self.positions[row], self.positions[after], share)
        if self._has_floating_base:
            here, there = self.positions[row, 3:7], self.positions[after, 3:7]
            q[3:7] = interpolate_rows(here, there, np.asarray(share))
            q[:2] += laps * (self.positions[-1, :2] - self.positions[0, :2])
        return q, _interpolate(self.velocities[row], self.velocities[after], share)

    @property
    def _has_floating_base(self) -> bool:
        """Whether it is the motion of a robot whose base floats."""
        more = self.positions.shape[1] - self.velocities.shape[1]
        if more > 1:
            raise ConfigError(
                "This trajectory has several floating bases; use that of one robot, for example "
                "Log.trajectory(robot)."
            )
        return bool(more == 1)

    def save(self, path: str | Path) -> None:
        """Write the trajectory to an HDF5 file."""
        import h5py

        with h5py.File(path, "w") as file:
            file.attrs["format"], file.attrs["beyond"] = "physx trajectory", self.beyond
            for name in ("times", "positions", "velocities"):
                file.create_dataset(name, data=getattr(self, name))

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Read a file written by `save`.

        Raises:
            LogError: If the file is not a trajectory.
        """
        import h5py

        try:
            with h5py.File(path, "r") as file:
                if file.attrs.get("format") != "physx trajectory":
                    raise LogError(f"{path} is not a trajectory.")
                names = ("times", "positions", "velocities")
                if not all(isinstance(file.get(n, getlink=True), h5py.HardLink) for n in names):
                    raise LogError(f"{path} is not a trajectory: parts are missing or links.")
                times, positions, velocities = (np.asarray(file[n], float) for n in names)
                beyond: Any = file.attrs["beyond"]
                return cls(times, positions, velocities, beyond)
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise LogError(f"{path} cannot be read as a trajectory: {error}") from error


def _interpolate(first: Vector, second: Vector, share: float) -> Vector:
    value: Vector = first + share * (second - first)
    return value
