"""What both sides of the protocol physx agree on: frames, roles, and spaces as stacked arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from physx_core.errors import ActionError, RemoteProtocolError, RequestError, UsageError
from physx_core.net import HANDSHAKE_LIMIT, HEADER, Kind, encode
from physx_core.typing import Array
from physx_remote.serving.framing import Reader
from physx_remote.serving.spaces import Space, join, leaves

VERSION = 1
"""Version of what is said after the handshake."""

SERVICE = "physx environments"
"""How a service introduces itself, so that nobody takes it for the server of a run."""

ACT, OBSERVE = 1, 2
"""What a client wants to be, in the place of an instance's number in the handshake."""

WORLDS, IS_RESET, COUNT = "worlds", "is_reset", "count"
REWARD, TERMINATED, TRUNCATED = "reward", "terminated", "truncated"
"""Names of arrays beside those of observations and actions."""

_KINDS = frozenset(int(kind) for kind in Kind)


class PhysxReader(Reader):
    """Cuts frames of physx, header and payload together.

    Attributes:
        limit: Longest payload in bytes that is taken, that of a stranger's at first.
    """

    def __init__(self) -> None:
        """Begin in front of a header."""
        super().__init__()
        self.limit = HANDSHAKE_LIMIT

    def take(self) -> bytes | None:
        """Return the next whole frame, or None until more has arrived.

        Raises:
            RemoteProtocolError: What has arrived is no frame, or one that is too long.
        """
        buffer = self.buffer
        if len(buffer) < HEADER.size:
            return None
        length, kind, spare, _ = HEADER.unpack_from(buffer)
        if spare or kind not in _KINDS:
            raise RemoteProtocolError("The other side sent what is no message of physx.")
        if length > self.limit:
            raise RemoteProtocolError(
                f"The other side announced a message of {length} bytes; at most {self.limit} are "
                "taken here."
            )
        end = HEADER.size + length
        if len(buffer) < end:
            return None
        frame = bytes(buffer) if len(buffer) == end else bytes(memoryview(buffer)[:end])
        del buffer[:end]
        return frame


class Leaves:
    """A space's values of several worlds as arrays, one for each part that has no parts itself.

    Each array has a leading axis of worlds.

    Attributes:
        space: The space of one world's values.
        names: Names of the arrays.
    """

    def __init__(self, space: Space, prefix: str) -> None:
        """Find the parts.

        Args:
            space: The space.
            prefix: What the arrays' names begin with.

        Raises:
            UsageError: A part has values without a fixed shape.
        """
        found = list(leaves(space))
        self.space = space
        self.names = [f"{prefix}{number}" for number in range(len(found))]
        self._paths = [path for path, _ in found]
        self._leaves = [leaf for _, leaf in found]
        self._dtypes = [np.dtype(leaf.dtype) for leaf in self._leaves]
        self._shapes = [tuple(leaf.shape or ()) for leaf in self._leaves]
        self._is_single = self._paths == [()]

    def zeros(self, count: int) -> dict[str, Array]:
        """Return arrays of zeros for so many worlds."""
        parts = zip(self.names, self._shapes, self._dtypes, strict=True)
        return {name: np.zeros((count, *shape), dtype) for name, shape, dtype in parts}

    def put(self, arrays: Sequence[Array], row: int, value: Any) -> None:
        """Write one world's value into a row of the arrays.

        Raises:
            ValueError, LookupError or TypeError: It is no value of the space.
        """
        if self._is_single:
            _put(arrays[0], row, value)
            return
        for array, path in zip(arrays, self._paths, strict=True):
            part = value
            for key in path:
                part = part[key]
            _put(array, row, part)

    def check(self, arrays: Mapping[str, Any], count: int) -> None:
        """Check arrays that were received.

        Raises:
            RequestError: One is missing, or of another type or shape.
        """
        for name, shape, dtype in zip(self.names, self._shapes, self._dtypes, strict=True):
            array = arrays.get(name)
            if not isinstance(array, np.ndarray):
                raise RequestError(f"The actions lack the array {name} of {self.space}.")
            if array.dtype != dtype or array.shape != (count, *shape):
                raise RequestError(
                    f"The array {name} has type {array.dtype} and shape {array.shape}, not {dtype} "
                    f"and {(count, *shape)}: {count} worlds with actions of {self.space}."
                )

    def rows(self, arrays: Mapping[str, Array], count: int) -> Iterable[Any]:
        """Return the value of each world."""
        if self._is_single:
            array = arrays[self.names[0]]
            if isinstance(self._leaves[0], spaces.Discrete):
                return list(array)
            return array if self._shapes[0] else [array[row, ...] for row in range(count)]
        return [self.row(arrays, row) for row in range(count)]

    def batch(self, arrays: Mapping[str, Array]) -> Any:
        """Return the worlds' values as one value of Gymnasium's batched space."""
        if self._is_single:
            return arrays[self.names[0]]
        return join(self.space, iter([arrays[name] for name in self.names]))

    def row(self, arrays: Mapping[str, Array], row: int) -> Any:
        """Return one world's value: parts of the arrays."""
        if self._is_single:
            return self._item(0, arrays, row)
        return join(self.space, (self._item(i, arrays, row) for i in range(len(self.names))))

    def stacked(self, value: Any, *, one: bool = False) -> dict[str, Array]:
        """Return arrays of a batch of values, or of one value.

        Args:
            value: Value of Gymnasium's batched space, or of the space itself.
            one: Whether it is the value of one world.

        Raises:
            ActionError: It has another structure, or other numbers than the space.
        """
        arrays = {}
        for place, name in enumerate(self.names):
            part = value
            try:
                for key in self._paths[place]:
                    part = part[key]
                array = _typed(part, self._dtypes[place])
            except (TypeError, ValueError, LookupError, OverflowError) as error:
                raise ActionError(
                    f"{value!r:.200} is no action of {self.space}: {error!r}."
                ) from error
            arrays[name] = array[None] if one else array
            if arrays[name].shape[1:] != self._shapes[place]:
                raise ActionError(
                    f"An action has the shape {arrays[name].shape[1:]}, and {self._leaves[place]} "
                    f"has the shape {self._shapes[place]}."
                )
        return arrays

    def _item(self, place: int, arrays: Mapping[str, Array], row: int) -> Any:
        array = arrays[self.names[place]]
        return array[row] if isinstance(self._leaves[place], spaces.Discrete) else array[row, ...]


def _put(array: Array, row: int, value: Any) -> None:
    """Write a value into a row; a value of another shape is not stretched.

    Raises:
        ValueError: The shapes differ.
    """
    if np.shape(value) != array.shape[1:]:
        raise ValueError(f"it has the shape {np.shape(value)}, not {array.shape[1:]}")
    array[row] = value


def _typed(value: Any, dtype: np.dtype[Any]) -> Array:
    """Return a value as an array of a type; numbers are not cut to whole ones.

    Raises:
        ValueError: It has numbers that the type cannot hold.
    """
    array = np.asarray(value)
    if array.dtype == dtype:
        return array
    if array.dtype.kind not in "biuf":
        raise ValueError("these are no numbers")
    typed = array.astype(dtype)
    if dtype.kind in "biu" and not (typed == array).all():
        raise ValueError(f"{dtype} cannot hold these numbers")
    return typed


def encoded_infos(infos: Sequence[Mapping[str, Any]]) -> bytes:
    """Return infos as bytes, as far as they are plain values; what is not is named besides."""
    left_out: set[str] = set()
    try:
        return encode({"infos": [dict(info) for info in infos], "left_out": []}, "info")
    except UsageError:
        plain = [_plain(info, left_out) for info in infos]
    return encode({"infos": plain, "left_out": sorted(left_out)}, "info")


def _plain(info: Mapping[str, Any], left_out: set[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in info.items():
        name = str(key)
        if isinstance(value, Mapping):
            found[name] = _plain(value, left_out)
            continue
        try:
            encode([value], name)
        except UsageError:
            left_out.add(name)
        else:
            found[name] = value
    return found


def infos_of(value: Any, count: int) -> tuple[list[dict[str, Any]], list[str]]:
    """Return what `encoded_infos` was given, and the names of what was left out.

    Args:
        value: What it encoded.
        count: Of how many worlds.

    Raises:
        RemoteProtocolError: These are no infos of so many worlds.
    """
    if isinstance(value, dict):
        infos, left_out = value.get("infos"), value.get("left_out")
        if isinstance(infos, list) and isinstance(left_out, list) and len(infos) == count:
            return [info if isinstance(info, dict) else {} for info in infos], left_out
    raise RemoteProtocolError(f"The other side sent infos that are not those of {count} worlds.")
