"""Gymnasium spaces: their leaves, and spaces and values as JSON data."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from functools import reduce
from operator import getitem
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces

from physx_core.errors import UsageError
from physx_core.typing import Array
from physx_remote.errors import RemoteProtocolError, RequestError

Space: TypeAlias = spaces.Space[Any]
Leaf: TypeAlias = spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete
Path: TypeAlias = tuple[Any, ...]

MALFORMED_INPUT_ERRORS: tuple[type[Exception], ...] = (
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError, AssertionError),
    *(RecursionError, MemoryError),
)
"""Exceptions that malformed received data may raise."""

_LARGEST = 1 << 26

KINDS = "Box, Discrete, MultiBinary, MultiDiscrete, Dict and Tuple"


class SpaceTree:
    """A space as a sequence of leaves: the parts that have no parts themselves.

    Attributes:
        space: The space.
        paths: The keys that lead to each leaf; ``()`` for a space without parts.
        leaves: The leaves, in the order of the space.
        is_leaf: Whether the space itself has no parts.
    """

    def __init__(self, space: Space) -> None:
        """Find the leaves."""
        found = list(_leaves(space))
        self.space = space
        self.paths: list[Path] = [path for path, _ in found]
        self.leaves: list[Leaf] = [leaf for _, leaf in found]
        self.is_leaf = self.paths == [()]

    def split(self, value: Any) -> list[Any]:
        """Return the leaves' values in a value of the space."""
        return [value] if self.is_leaf else [reduce(getitem, p, value) for p in self.paths]

    def join(self, values: Iterable[Any]) -> Any:
        """Return the value of the space whose leaves have these values."""
        return _join(self.space, iter(values))


def _leaves(space: Space) -> Iterator[tuple[Path, Leaf]]:
    parts: Iterator[tuple[Any, Space]] | None = None
    if isinstance(space, spaces.Dict):
        parts = iter(space.items())
    elif isinstance(space, spaces.Tuple):
        parts = enumerate(space)
    if parts is not None:
        for key, part in parts:
            for path, leaf in _leaves(part):
                yield (key, *path), leaf
    elif isinstance(space, Leaf):
        yield (), space
    else:
        raise _no_layout(space)


def _join(space: Space, values: Iterator[Any]) -> Any:
    if isinstance(space, spaces.Dict):
        return {name: _join(part, values) for name, part in space.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_join(part, values) for part in space)
    return next(values)


def _no_layout(space: Space) -> UsageError:
    return UsageError(f"{space} has no fixed layout: only {KINDS} can be served.")


def cast_exactly(value: Any, dtype: np.dtype[Any]) -> Array:
    """Return numbers as an array of a type; some programs send integers as 1.0."""
    array = np.asarray(value)
    if array.dtype == dtype:
        return array
    if array.dtype.kind not in "biuf":
        raise ValueError("these are not numbers")
    with np.errstate(over="ignore", invalid="ignore"):
        typed = array.astype(dtype)
    if dtype.kind in "biu" and not (typed == array).all():
        raise ValueError(f"{dtype} cannot hold these numbers")
    return typed


def find_invalid(leaf: Leaf, values: Array) -> tuple[int, ...] | None:
    """Return the index of the first value that is not valid in a space; None if all are valid.

    Floating-point values must be finite. Their bounds are up to the environment, as in Gymnasium:
    many environments clip them, or accept more than they declare. Integers must be in range.

    Args:
        leaf: The space.
        values: Elements of the space, with any leading axes.
    """
    if isinstance(leaf, spaces.Box) and values.dtype.kind == "f":
        valid = np.isfinite(values)
    else:
        low, high = _range(leaf)
        valid = (values >= low) & (values <= high)
    if valid.all():
        return None
    return tuple(np.argwhere(~valid)[0].tolist())


def _range(leaf: Leaf) -> tuple[Any, Any]:
    """Return the smallest and largest elements of a space of integers."""
    if isinstance(leaf, spaces.Box):
        return leaf.low, leaf.high
    if isinstance(leaf, spaces.MultiBinary):
        return 0, 1
    count = leaf.n if isinstance(leaf, spaces.Discrete) else leaf.nvec
    return leaf.start, leaf.start + (count - 1)


def invalid_value(leaf: Leaf, place: str, value: Any) -> RequestError:
    """Return the error for a value that is not valid in a space.

    Args:
        leaf: The space.
        place: Description of the value, such as ``The action[2]``.
        value: The value.
    """
    is_float = isinstance(leaf, spaces.Box) and np.issubdtype(leaf.dtype, np.floating)
    wanted = "a finite number" if is_float else f"an element of {leaf}"
    return RequestError(f"{place} is {value}, which is not {wanted}.")


def subscripts(keys: Iterable[Any]) -> str:
    """Return keys and indices in Python's notation, such as ``["arm"][2]``."""
    return "".join(f'["{key}"]' if isinstance(key, str) else f"[{key}]" for key in keys)


# JSON data -------------------------------------------------------------------------------------


def describe_space(space: Space) -> dict[str, Any]:
    """Return a space as JSON data."""
    kind = type(space).__name__
    match space:
        case spaces.Box():
            bounds = {"low": _bounds(space.low), "high": _bounds(space.high)}
            return {"kind": kind, "shape": [*space.shape], "dtype": space.dtype.str, **bounds}
        case spaces.Discrete():
            start, count = int(space.start), int(space.n)
            return {"kind": kind, "n": count, "start": start, "dtype": space.dtype.str}
        case spaces.MultiBinary():
            bits = space.n  # a number and a shape of one number are different spaces
            return {"kind": kind, "n": bits if isinstance(bits, int) else [*space.shape]}
        case spaces.MultiDiscrete():
            counts, starts = space.nvec.tolist(), space.start.tolist()
            return {"kind": kind, "nvec": counts, "start": starts, "dtype": space.dtype.str}
        case spaces.Dict():
            return {"kind": kind, "spaces": {k: describe_space(s) for k, s in space.items()}}
        case spaces.Tuple():
            return {"kind": kind, "spaces": [describe_space(part) for part in space]}
    raise _no_layout(space)


def build_space(plain: Mapping[str, Any]) -> Space:
    """Return the space described by the result of `describe_space`."""
    try:
        return _build(plain)
    except MALFORMED_INPUT_ERRORS as error:
        raise RemoteProtocolError(
            "The other side sent an invalid description of a space, "
            f"{reprlib.repr(plain):.200}: {error!r}."
        ) from error


def _build(plain: Mapping[str, Any]) -> Space:
    match plain["kind"]:
        case "Box":
            shape, dtype = check_shape(plain["shape"]), np.dtype(plain["dtype"])
            low, high = (_limits(plain[side], shape, dtype) for side in ("low", "high"))
            return spaces.Box(low, high, shape, dtype.type)
        case "Discrete":
            return spaces.Discrete(plain["n"], start=plain["start"], dtype=plain["dtype"])
        case "MultiBinary":
            bits = plain["n"]
            check_shape(bits if isinstance(bits, list) else [bits])
            return spaces.MultiBinary(bits)
        case "MultiDiscrete":
            dtype = np.dtype(plain["dtype"]).type
            return spaces.MultiDiscrete(plain["nvec"], dtype=dtype, start=plain["start"])
        case "Dict":
            parts = [(name, _build(part)) for name, part in plain["spaces"].items()]
            return spaces.Dict(parts)  # a dictionary would be sorted
        case "Tuple":
            return spaces.Tuple([_build(part) for part in plain["spaces"]])
    raise ValueError(f"unknown kind {plain['kind']!r}")


def check_shape(sizes: Iterable[Any], num_worlds: int = 1) -> tuple[int, ...]:
    """Return a received shape, after validating it.

    Args:
        sizes: The shape.
        num_worlds: Number of arrays with that shape.

    Raises:
        ValueError: If it is not the shape of an array that fits into memory.
    """
    shape = tuple(sizes)
    if not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError(f"{reprlib.repr(shape)} is not a shape")
    if num_worlds * math.prod(shape) > _LARGEST:
        raise ValueError(f"more than {_LARGEST} numbers, in arrays of shape {reprlib.repr(shape)}")
    return shape


def _bounds(array: Array) -> Any:
    """Return bounds as one number if all are equal; infinite ones become strings."""
    flat = array.ravel()
    if flat.size and (flat == flat[0]).all():
        return _number(flat[0].item())
    return [_number(value) for value in flat.tolist()]


def _number(value: float) -> float | str:
    return value if math.isfinite(value) else repr(value)


def _limits(plain: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
    numbers = plain if isinstance(plain, list) else [plain]
    values = [float(number) if isinstance(number, str) else number for number in numbers]
    array = np.array(values, dtype)
    return array.reshape(shape) if isinstance(plain, list) else np.full(shape, array[0])


def to_json(space: Space, value: Any) -> Any:
    """Return a value of any space as lossless JSON data."""
    if isinstance(space, spaces.Dict):
        return {name: to_json(part, value[name]) for name, part in space.items()}
    if isinstance(space, spaces.Tuple):
        return [to_json(part, item) for part, item in zip(space, value, strict=True)]
    return np.asarray(value).tolist()


def from_json(space: Space, plain: Any, place: str = "The action") -> Any:
    """Return the value of a space represented by JSON data."""
    try:
        if isinstance(space, spaces.Dict):
            return {n: from_json(s, plain[n], f'{place}["{n}"]') for n, s in space.items()}
        if isinstance(space, spaces.Tuple):
            parts = zip(space, plain, strict=True)
            return tuple(from_json(s, p, f"{place}[{i}]") for i, (s, p) in enumerate(parts))
        value = cast_exactly(plain, np.dtype(space.dtype))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise RequestError(f"{place} must be in {space}, not {plain!r:.100}: {error!r}.") from None
    if value.shape != (space.shape or ()):
        raise RequestError(f"{place} has shape {value.shape}, but {space} has shape {space.shape}.")
    if isinstance(space, Leaf):
        index = find_invalid(space, value)
        if index is not None:
            raise invalid_value(space, f"{place}{subscripts(index)}", value[index])
    return value.dtype.type(value) if isinstance(space, spaces.Discrete) else value
