"""External forces on a body: permanent, for a limited time, or following a profile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from physx_core import checks
from physx_core.errors import ConfigError, UnknownOptionError

Frame = Literal["world", "body"]


@dataclass(frozen=True, eq=False)
class Wrench:
    """A force and a torque on a body.

    Without `duration` and `times` it acts until it is removed; with `duration` it is a pulse; with
    `times` it follows a profile that is linear between its points and 0 after the last.

    Attributes:
        body: Name of the link or object.
        force: In N, shape (3,), or (k, 3) for a profile.
        torque: In N m, shape (3,), or (k, 3) for a profile.
        point: Point of application, in the body's frame, in m.
        frame: Frame of force and torque: ``"world"`` or ``"body"``.
        duration: Time for which it acts, in s, rounded to physics steps, at least one; None: until
            it is removed or the profile ends.
        times: Times of the profile's points since it was applied, in s, shape (k,), increasing.

    Raises:
        UnknownOptionError: If there is no such frame.
        ConfigError: If the body is not a name, a shape is wrong, the times do not increase, or a
            number is out of range.
    """

    body: str
    force: NDArray[np.float64] | tuple[float, ...] = (0.0, 0.0, 0.0)
    torque: NDArray[np.float64] | tuple[float, ...] = (0.0, 0.0, 0.0)
    point: tuple[float, ...] = (0.0, 0.0, 0.0)
    frame: Frame = "world"
    duration: float | None = None
    times: NDArray[np.float64] | tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        where = f"Wrench on {self.body!r}: "
        if not isinstance(self.body, str):
            raise ConfigError(f"{where}body must be a name.")
        if self.frame not in ("world", "body"):
            raise UnknownOptionError(f"{where}frame", [str(self.frame)], ("world", "body"))
        checks.store_declared(where, self)
        object.__setattr__(self, "point", checks.vector(f"{where}point", self.point, 3))
        if self.duration is not None:
            checks.positive(f"{where}duration", self.duration)
        shape: tuple[int, ...] = (3,)
        if self.times is not None:
            times = np.asarray(self.times)
            rises = times.ndim == 1 and len(times) > 0 and (np.diff(times) > 0).all()
            if not rises or not np.isfinite(times).all():
                raise ConfigError(f"{where}times must be a vector of increasing, finite numbers.")
            shape = (len(times), 3)
        for option in ("force", "torque"):
            values: Any = getattr(self, option)
            if self.times is not None and values.shape == (3,):
                values = np.tile(values, (shape[0], 1))
            if values.shape != shape:
                raise ConfigError(
                    f"{where}{option} has the shape {values.shape} but needs {shape}."
                )
            if not np.isfinite(values).all():
                raise ConfigError(f"{where}{option} must be finite numbers.")
            object.__setattr__(self, option, values)

    def at(self, time: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return force and torque, shape (3,) each, at a time in s after it was applied."""
        force, torque = np.asarray(self.force), np.asarray(self.torque)
        if self.times is None:
            return force, torque
        times = np.asarray(self.times)
        if not times[0] <= time <= times[-1]:
            return np.zeros(3), np.zeros(3)
        after = min(max(int(np.searchsorted(times, time)), 1), len(times) - 1)
        if len(times) == 1:
            return force[0], torque[0]
        share = (time - times[after - 1]) / (times[after] - times[after - 1])
        return (
            force[after - 1] + share * (force[after] - force[after - 1]),
            torque[after - 1] + share * (torque[after] - torque[after - 1]),
        )

    def steps(self, period: float) -> int | None:
        """Return the number of physics steps for which it acts; None: until it is removed."""
        if self.duration is not None:
            return max(1, round(self.duration / period))
        if self.times is not None:
            return int(np.floor(float(self.times[-1]) / period * (1 + 1e-12))) + 1
        return None
