"""Spaces of Gymnasium as plain data, and the values of nested spaces as lists of arrays."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces

from physx_core.errors import RemoteProtocolError, RequestError, UsageError
from physx_core.typing import Array

Space: TypeAlias = spaces.Space[Any]
Leaf: TypeAlias = spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete

KINDS = "Box, Discrete, MultiBinary, MultiDiscrete, Dict and Tuple"


def describe_space(space: Space) -> dict[str, Any]:
    """Return a space as plain data for JSON.

    Raises:
        UsageError: It is a space whose values have no fixed shape.
    """
    kind = type(space).__name__
    match space:
        case spaces.Box():
            bounds = {"low": _bounds(space.low), "high": _bounds(space.high)}
            return {"kind": kind, "shape": [*space.shape], "dtype": space.dtype.str, **bounds}
        case spaces.Discrete():
            start, count = int(space.start), int(space.n)
            return {"kind": kind, "n": count, "start": start, "dtype": space.dtype.str}
        case spaces.MultiBinary():
            bits = space.n  # a number is another space than a shape of one number
            return {"kind": kind, "n": bits if isinstance(bits, int) else [*space.shape]}
        case spaces.MultiDiscrete():
            counts, starts = space.nvec.tolist(), space.start.tolist()
            return {"kind": kind, "nvec": counts, "start": starts, "dtype": space.dtype.str}
        case spaces.Dict():
            return {"kind": kind, "spaces": {k: describe_space(s) for k, s in space.items()}}
        case spaces.Tuple():
            return {"kind": kind, "spaces": [describe_space(part) for part in space]}
    raise UsageError(f"{space} has no fixed layout: only {KINDS} can be driven from elsewhere.")


def build_space(plain: Mapping[str, Any]) -> Space:
    """Return the space that `describe_space` described.

    Raises:
        RemoteProtocolError: It is no such description.
    """
    try:
        return _built(plain)
    except (KeyError, TypeError, ValueError, AssertionError, AttributeError) as error:
        raise RemoteProtocolError(
            f"The other side described a space as {plain!r:.200}, which is none: {error!r}."
        ) from error


def _built(plain: Mapping[str, Any]) -> Space:
    match plain["kind"]:
        case "Box":
            shape, dtype = tuple(plain["shape"]), np.dtype(plain["dtype"])
            low, high = (_limits(plain[side], shape, dtype) for side in ("low", "high"))
            return spaces.Box(low, high, shape, dtype.type)
        case "Discrete":
            return spaces.Discrete(plain["n"], start=plain["start"], dtype=plain["dtype"])
        case "MultiBinary":
            return spaces.MultiBinary(plain["n"])
        case "MultiDiscrete":
            dtype = np.dtype(plain["dtype"]).type
            return spaces.MultiDiscrete(plain["nvec"], dtype=dtype, start=plain["start"])
        case "Dict":
            parts = [(name, _built(part)) for name, part in plain["spaces"].items()]
            return spaces.Dict(parts)  # a dictionary would be sorted
        case "Tuple":
            return spaces.Tuple([_built(part) for part in plain["spaces"]])
    raise ValueError(f"there is no kind {plain['kind']!r}")


def _bounds(array: Array) -> Any:
    """Return bounds as one number where all are the same, infinite ones as texts."""
    flat = array.ravel()
    if flat.size and (flat == flat[0]).all():
        return _number(flat[0].item())
    return [_number(value) for value in flat.tolist()]


def _number(value: float) -> float | str:
    return value if math.isfinite(value) else repr(value)


def _limits(plain: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
    numbers = plain if isinstance(plain, list) else [plain] * math.prod(shape)
    values = [float(number) if isinstance(number, str) else number for number in numbers]
    return np.array(values, dtype).reshape(shape)


def leaves(space: Space) -> Iterator[tuple[tuple[Any, ...], Leaf]]:
    """Yield the parts of a space that have none themselves, with the keys that lead to them.

    Raises:
        UsageError: A part is a space whose values have no fixed shape.
    """
    parts: Iterator[tuple[Any, Space]] | None = None
    if isinstance(space, spaces.Dict):
        parts = iter(space.items())
    elif isinstance(space, spaces.Tuple):
        parts = enumerate(space)
    if parts is not None:
        for key, part in parts:
            for path, leaf in leaves(part):
                yield (key, *path), leaf
        return
    plain = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)
    if not isinstance(space, plain):
        raise UsageError(f"{space} has no fixed layout: only {KINDS} can be driven from elsewhere.")
    yield (), space


def join(space: Space, values: Iterator[Any]) -> Any:
    """Return a value of a space, made from the values of its leaves in their order."""
    if isinstance(space, spaces.Dict):
        return {name: join(part, values) for name, part in space.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(join(part, values) for part in space)
    return next(values)


def to_json(space: Space, value: Any) -> Any:
    """Return a value of a space as plain data for JSON, without loss."""
    if isinstance(space, spaces.Dict):
        return {name: to_json(part, value[name]) for name, part in space.items()}
    if isinstance(space, spaces.Tuple):
        return [to_json(part, item) for part, item in zip(space, value, strict=True)]
    return np.asarray(value).tolist()


def from_json(space: Space, plain: Any, place: str = "The action") -> Any:
    """Return the value of a space that plain data of JSON stand for.

    Raises:
        RequestError: They have another structure or shape.
    """
    try:
        if isinstance(space, spaces.Dict):
            return {n: from_json(s, plain[n], f'{place}["{n}"]') for n, s in space.items()}
        if isinstance(space, spaces.Tuple):
            parts = zip(space, plain, strict=True)
            return tuple(from_json(s, p, f"{place}[{i}]") for i, (s, p) in enumerate(parts))
        value = _numbers(plain, np.dtype(space.dtype))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise RequestError(f"{place} is of {space}, not {plain!r:.100}: {error!r}.") from None
    if value.shape != (space.shape or ()):
        raise RequestError(
            f"{place} has the shape {value.shape}, and {space} has the shape {space.shape}."
        )
    return value.dtype.type(value) if isinstance(space, spaces.Discrete) else value


def _numbers(plain: Any, dtype: np.dtype[Any]) -> Array:
    """Return numbers in the type of a space; some programs send whole numbers as 1.0."""
    given = np.array(plain)
    if given.dtype.kind not in "biuf" and given.size:
        raise ValueError("these are no numbers")
    value = given.astype(dtype)
    if dtype.kind in "iu" and given.dtype.kind == "f" and not (given == value).all():
        raise ValueError("these are no whole numbers")
    return value
