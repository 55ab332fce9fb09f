"""Options of objects: what each accepts, and the plain value that is sent for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core.components.scene.colors import colormap, parse_color
from physx_core.errors import ConfigError, listed
from physx_core.fields import NO_ARRAY
from physx_core.typing import Array

Check = Callable[[Any], Any]
"""Returns the plain value of an option, or raises a ConfigError that says what is wrong."""

LARGEST = 1e30
"""Bound of numbers that may be squared and stored in 32 bits without further checks."""
_SMALL = 1000


@dataclass(frozen=True)
class Numbers:
    """An option that is an array of finite numbers.

    Attributes:
        shape: Its shape; None: any length.
        dtype: Type that it is converted to.
    """

    shape: tuple[int | None, ...]
    dtype: type = np.float32

    def __call__(self, value: Any, count: int | None = None) -> Array:
        """Return a copy of the array, or of one for each of `count` objects.

        Raises:
            ConfigError: If it is not such an array.
        """
        shape = self.shape if count is None else (count, *self.shape)
        # The common case, in few operations; what it refuses is checked in full below.
        raw = value if type(value) is np.ndarray else _as_array(value)
        if (
            raw.dtype.kind == "f"
            and self.dtype is not np.int32
            and raw.size <= _SMALL
            and (raw.shape == shape or _fits(raw.shape, shape))
        ):
            flat = raw.ravel()
            if raw.itemsize < 8:  # their squares may be too large
                flat = flat.astype(np.float64)
            if float(flat.dot(flat)) < LARGEST**2:
                return raw.astype(self.dtype)
        if not _fits(raw.shape, shape):
            wanted = str(shape).replace("None", "n")
            raise ConfigError(f"has shape {raw.shape}, expected {wanted}")
        if raw.dtype.kind not in "biufO":
            raise ConfigError(f"is not an array of numbers, but of {raw.dtype}")
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                array: Array = raw.astype(self.dtype)
        except NO_ARRAY as error:
            raise ConfigError(f"is not an array of numbers: {error}") from error
        if self.dtype is np.int32:
            if not np.array_equal(array, raw):
                raise ConfigError("contains numbers that are not indices")
        elif not np.isfinite(array).all():
            place = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
            raise ConfigError(f"is {array[place]} at index {place}, but must be finite")
        return array


def _fits(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    if len(shape) != len(wanted):
        return False
    for want, have in zip(wanted, shape, strict=True):
        if want is not None and want != have:
            return False
    return True


def _as_array(value: Any) -> Array:
    try:
        return np.asarray(value)
    except NO_ARRAY as error:
        raise ConfigError(f"is not an array of numbers: {error}") from error


def many(check: Check, value: Any, count: int, *, resettable: bool = False) -> Any:
    """Return the plain values of an option of several objects.

    Args:
        check: The option's check.
        value: One entry for each object; for arrays, one array with this leading axis.
        count: Number of objects.
        resettable: Whether an entry may be None.
    """
    if isinstance(check, Numbers):
        return check(value, count)
    if isinstance(value, str) or not hasattr(value, "__len__") or len(value) != count:
        raise ConfigError(f"must have {count} entries, one for each object")
    return [None if resettable and entry is None else check(entry) for entry in value]


def number(low: float, *, or_equal: bool = False, high: float = math.inf) -> Check:
    """Return a check for a number greater than `low`, or equal if allowed, and at most `high`."""

    def check(value: Any) -> float:
        try:
            found = float(value)
        except NO_ARRAY:
            found = math.nan
        if isinstance(value, (str, bytes, bool, np.bool_)) or not (
            low < found <= high or (or_equal and found == low)
        ):
            relation = "at least" if or_equal else "greater than"
            limits = [f"{relation} {low:g}"] if low > -math.inf else []
            limits += [f"at most {high:g}"] if high < math.inf else []
            wanted = " ".join(["a finite number", " and ".join(limits)]).strip()
            raise ConfigError(f"is {value!r} but must be {wanted}")
        if math.isinf(found):
            raise ConfigError(f"is {value!r} but must be a finite number")
        return found

    return check


def color(value: Any) -> Any:
    """Check a color: see `parse_color`."""
    try:
        parsed = parse_color(value)
    except ConfigError as error:
        raise ConfigError(f"cannot be used: {error}") from error
    return value if isinstance(value, str) else parsed


def colormap_name(value: Any) -> str:
    """Check the name of a colormap: see `colormap`."""
    try:
        colormap(value)
    except ConfigError as error:
        raise ConfigError(f"cannot be used: {error}") from error
    return str(value)


def flag(value: Any) -> bool:
    """Check a boolean."""
    if not isinstance(value, (bool, np.bool_)):
        raise ConfigError(f"is {value!r} but must be True or False")
    return bool(value)


def text(value: Any) -> str:
    """Convert anything to a string."""
    return str(value)


def texts(value: Any) -> list[str]:
    """Convert a sequence to a list of strings."""
    if isinstance(value, (str, bytes)) or not np.iterable(value):
        raise ConfigError(f"is {value!r} but must be a list of strings")
    return [str(entry) for entry in value]


def folders(value: Any) -> dict[str, str]:
    """Convert the names and folders of packages to strings."""
    if not isinstance(value, Mapping):
        raise ConfigError(f"is {value!r} but must give the folder of each package")
    return {str(package): str(folder) for package, folder in value.items()}


def choice(*known: str) -> Check:
    """Return a check for one of several words."""

    def check(value: Any) -> str:
        if not isinstance(value, str) or value not in known:
            raise ConfigError(f"is {value!r} but must be one of {listed(known)}")
        return str(value)

    return check


def lines(value: Any) -> list[Array]:
    """Check the corners of a line, shape (n, 3), or of each of several lines."""
    corners = Numbers((None, 3))
    try:
        several = len(value) > 0 and np.ndim(value[0]) == 2
    except NO_ARRAY:
        several = False
    return [corners(line) for line in value] if several else [corners(value)]


def image(value: Any) -> Array:
    """Check an image: gray (h, w), RGB or RGBA (h, w, 3 or 4); uint8, or in [0, 1]."""
    try:
        array: Array = np.array(value)
    except NO_ARRAY as error:
        raise ConfigError(f"is not an array: {error}") from error
    if array.ndim not in (2, 3) or not array.size or array.shape[2:] not in ((), (3,), (4,)):
        raise ConfigError(
            f"has shape {array.shape}, expected (height, width), (height, width, 3) or "
            "(height, width, 4)"
        )
    if array.dtype == np.uint8:
        return array
    if array.dtype.kind != "f" or not ((array >= 0) & (array <= 1)).all():
        raise ConfigError("must be uint8, or floats in [0, 1]")
    return np.round(255 * array).astype(np.uint8)
