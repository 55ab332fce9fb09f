"""Encodes blocks of rows, field by field and little-endian; queues the received ones."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from physx_core.errors import ConnectionRefusedByPeerError
from physx_core.fields import Field
from physx_core.net.frames import Kind, pack_header
from physx_core.packing import lengths, split
from physx_core.typing import Array, Batch

_SMALL = 1 << 14
"""Size in bytes up to which rows are copied into one message: faster than sending parts."""


def row_bytes(fields: Sequence[Field]) -> int:
    """Return the size in bytes of one row of fields with known shapes."""
    return sum(field.nbytes for field in fields)


def pack_rows(block: Batch, count: int, kind: Kind = Kind.ROWS) -> list[bytes | memoryview]:
    """Return the message for a block of rows, in parts, so that large blocks are not copied.

    Args:
        block: Field name to contiguous array of shape (count, *field shape).
        count: How many rows.
        kind: Kind of the message.
    """
    arrays = list(block.values())
    if any(array.dtype.hasobject for array in arrays):
        arrays = [part for array in arrays for part in _parts(array)]
    length = sum(array.nbytes for array in arrays)
    begin = pack_header(kind, length, count)
    if length <= _SMALL:
        return [b"".join((begin, *(array.data for array in arrays)))]
    return [begin, *(array.reshape(-1).view("u1").data for array in arrays)]


def unpack_rows(payload: bytearray, fields: Sequence[Field], count: int) -> Batch:
    """Return the rows of a message as views of its payload.

    Args:
        payload: Payload of the message.
        fields: Fields of the rows, all shapes known.
        count: Number of rows according to the header.
    """
    if any(field.free_axis for field in fields):
        return _unpack_free(payload, fields, count)
    sizes = [field.nbytes for field in fields]
    if len(payload) != count * sum(sizes):
        raise ConnectionRefusedByPeerError(
            f"A client sent {len(payload)} bytes for {count} rows of {sum(sizes)} bytes."
        )
    block: Batch = {}
    start = 0
    for field, size in zip(fields, sizes, strict=True):
        shape = (count, *(field.shape or ()))
        block[field.name] = np.ndarray(shape, field.dtype, buffer=payload, offset=start)
        start += count * size
    return block


def _parts(array: Array) -> list[Array]:
    """Return a field of rows as it is sent: with a free axis, the rows' sizes and their entries."""
    if not array.dtype.hasobject:
        return [array]
    sizes = lengths(array).astype("<u8")
    return [sizes, np.concatenate(array.tolist())] if len(array) else [sizes]


def _unpack_free(payload: bytearray, fields: Sequence[Field], count: int) -> Batch:
    """Return the rows of a message, some of whose fields have a free axis."""
    block: Batch = {}
    start = 0

    def take(shape: tuple[int, ...], field: Field, nbytes: int) -> Array:
        nonlocal start
        if nbytes > len(payload) - start:
            raise ConnectionRefusedByPeerError(
                f'A client sent {len(payload)} bytes, too few for its field "{field.name}".'
            )
        found: Array = np.ndarray(shape, field.dtype, buffer=payload, offset=start)
        start += nbytes
        return found

    for field in fields:
        if not field.free_axis:
            shape = (count, *field.entry_shape)
            block[field.name] = take(shape, field, count * field.nbytes)
            continue
        sizes = take((count,), Field(field.free_axis, (), "<u8"), 8 * count)
        if len(sizes) and sizes.max() > len(payload):
            raise ConnectionRefusedByPeerError(f"A client sent rows of {sizes.max()} entries.")
        counts = sizes.astype(np.intp)
        total = int(counts.sum())
        entries = take((total, *field.entry_shape), field, total * field.nbytes)
        block[field.name] = split(entries, counts)
    if start != len(payload):
        raise ConnectionRefusedByPeerError(
            f"A client sent {len(payload)} bytes for {count} rows of {start} bytes."
        )
    return block


class ReceivedRows:
    """Queue of rows received from one client.

    Attributes:
        count: Number of rows in the queue.
    """

    def __init__(self) -> None:
        self.count = 0
        self._blocks: deque[Batch] = deque()
        self._taken = 0

    def append(self, block: Batch, count: int) -> None:
        """Append a block of rows."""
        self._blocks.append(block)
        self.count += count

    def take(self, limit: int, out: Batch, first: int, stride: int) -> int:
        """Move rows into every `stride`-th row of a batch.

        Args:
            limit: Maximum number of rows.
            out: The batch.
            first: Row of `out` for the first one.
            stride: Distance between rows of `out`.

        Returns:
            Number of rows moved.
        """
        moved = 0
        while moved < limit and self.count:
            block, start = self._blocks[0], self._taken
            available = len(next(iter(block.values()))) - start
            size = min(available, limit - moved)
            begin = first + moved * stride
            rows = slice(begin, begin + (size - 1) * stride + 1, stride)
            for name, values in block.items():
                target: Array = out[name]
                target[rows] = values[start : start + size]
            if size == available:
                self._blocks.popleft()
                self._taken = 0
            else:
                self._taken += size
            moved += size
            self.count -= size
        return moved


class RejectedRows:
    """Rows received from one client that `check_sample` rejected, ordered by step.

    Attributes:
        count: Number of rows received in total.
    """

    def __init__(self) -> None:
        self.count = 0
        self._blocks: deque[Batch] = deque()

    def append(self, block: Batch, count: int) -> None:
        """Append a block of rows."""
        self._blocks.append(block)
        self.count += count

    def take(self, end: int | None) -> list[Batch]:
        """Remove and return the rows of steps below `end`, or all rows if it is None."""
        taken = []
        while self._blocks:
            block = self._blocks[0]
            steps = block["step"]
            size = len(steps) if end is None else int(np.searchsorted(steps, end))
            if size:
                taken.append({name: values[:size] for name, values in block.items()})
            if size < len(steps):
                self._blocks[0] = {name: values[size:] for name, values in block.items()}
                break
            self._blocks.popleft()
        return taken
