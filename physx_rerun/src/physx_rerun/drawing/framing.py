"""Frame: the view of one scene's camera."""

from __future__ import annotations

import numpy as np

from physx_core.typing import Array

VIEW_FROM = np.array([1.0, -1.1, 0.65]) / np.linalg.norm([1.0, -1.1, 0.65])
"""Direction from the target to the camera."""

RIGHT = np.array([1.1, 1.0, 0.0]) / np.linalg.norm([1.1, 1.0])
"""Direction to the right in the picture."""

_UP = np.cross(RIGHT, -VIEW_FROM)
_SLOPE = np.tan(np.deg2rad(55 / 2))  # of the edges of Rerun's pictures, even square ones
_FILLED = 0.85  # fraction of the picture that the box fills at first
_POINT = 0.5  # half the edge of the box shown around a single point, in m
_RESERVE = 0.25  # fraction by which the view exceeds a scene that has outgrown it


class Frame:
    """The box around everything that was ever in a scene."""

    def __init__(self) -> None:
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._shown: tuple[Array, Array] | None = None
        self._position: Array | None = None

    def grow(self) -> bool:
        """Zoom out if something is out of view, and return whether something was."""
        if self._shown is None or self.shows(self._low, self._high):
            return False
        reserve = _RESERVE * (self._high - self._low)
        self._shown = self._low - reserve, self._high + reserve
        return True

    def shows(self, low: Array, high: Array) -> bool:
        """Return whether a box is in view.

        Args:
            low: Lower corner of the box, shape (3,), in m.
            high: Upper corner of the box, shape (3,), in m.
        """
        if self._position is None:
            return False
        corners = _corners(low, high) - self._position
        sides = np.maximum(np.abs(corners @ RIGHT), np.abs(corners @ _UP))
        return bool((sides <= _SLOPE * -(corners @ VIEW_FROM)).all())

    def see(self, low: Array, high: Array) -> None:
        """Extend the scene's box by another one: see `shows`."""
        if np.isfinite(low).all() and np.isfinite(high).all():
            self._low, self._high = np.minimum(self._low, low), np.maximum(self._high, high)

    @property
    def size(self) -> float:
        """Diagonal of the box in m; 0 without objects."""
        if not np.isfinite(self._low).all():
            return 0.0
        return float(np.linalg.norm(self._high - self._low))

    def camera(
        self, target: Array | None = None, distance: float = 0.0
    ) -> tuple[Array, Array, float]:
        """Return the position, target and distance of the camera that shows everything.

        Args:
            target: Where the camera looks; None: at the middle.
            distance: Least distance, in m.
        """
        if self._shown is None and np.isfinite(self._low).all():
            self._shown = self._low, self._high
        low, high = self._shown or (np.zeros(3), np.zeros(3))
        middle = 0.5 * (low + high)
        look = middle if target is None else target
        half = 0.5 * (high - low)
        half = half if half.any() else np.full(3, _POINT)
        corners = _corners(middle - half, middle + half) - look
        sides = np.maximum(np.abs(corners @ RIGHT), np.abs(corners @ _UP))
        needed = float((corners @ VIEW_FROM + sides / (_FILLED * _SLOPE)).max())
        distance = max(needed, distance)
        self._position = look + distance * VIEW_FROM
        return self._position, look, distance


def _corners(low: Array, high: Array) -> Array:
    return np.where(_SIGNS, high, low)


_SIGNS = np.array([[x, y, z] for x in (False, True) for y in (False, True) for z in (False, True)])


def extremes(points: Array) -> tuple[Array, Array]:
    """Return the smallest and largest coordinates of points, shape (n, 3) with n > 0."""
    columns = np.ascontiguousarray(points.T)  # many times faster than reducing along the first axis
    return columns.min(axis=1), columns.max(axis=1)
