"""Reads rows from all partitions of a field through one flat index."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from physx_core import files
from physx_core.dataset.read.order.order import Order, Orders
from physx_core.dataset.store import manifest_file
from physx_core.dataset.store.episode_table import EPISODES
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.order_file import KeptCells
from physx_core.dataset.store.partition.commits import name_rows
from physx_core.dataset.store.partition.format import inspect
from physx_core.dataset.store.partition.segment import BLOCK, RowsCheck, Segment, rows_per_block
from physx_core.dataset.store.partition.spans import Span
from physx_core.errors import DatasetError, listed, nearest
from physx_core.fields import ENDS, Field
from physx_core.packing import split
from physx_core.typing import Array, Batch, Index


class Reader:
    """Reads the committed rows that a manifest lists.

    The rows of a mode are its *stored* rows, as they were written, unless the table of episodes has
    records about it: see `order`. Reading is by stored row.

    Reading raises a `DatasetError` if a partition is missing, truncated or damaged.

    Attributes:
        directory: The dataset's folder.
        manifest: The manifest; rows added to it later can be read too.
        orders: The orders of the modes with records.
        cells: Statistics of cells of modes with records, as far as they are known, by mode and
            field: see `physx_core.dataset.read.ordered_statistics`.
        stored_cells: Those that were stored, likewise.
    """

    def __init__(self, directory: Path, manifest: Manifest) -> None:
        self.directory = directory
        self.manifest = manifest
        self.orders = Orders(manifest, self._read_table)
        self._bounds: dict[tuple[str, str], tuple[int, Index]] = {}
        self.cells: dict[tuple[str, str], KeptCells] = {}
        self.stored_cells: dict[tuple[str, str], KeptCells] = {}

    def mode(self, mode: str) -> Mode:
        """Return a mode.

        Raises:
            DatasetError: If there is no such mode, or its rows cannot be counted.
        """
        modes = self.manifest.modes
        if mode not in modes:
            raise DatasetError(
                f'The dataset in {self.directory} has no mode "{mode}".{nearest(mode, modes)} '
                f"Modes: {listed(modes)}."
            )
        if mode in self.manifest.problems:
            raise self.manifest.problems[mode]
        return modes[mode]

    def field(self, mode: str, name: str) -> Field:
        """Return a field of a mode.

        Raises:
            DatasetError: If the mode has no such field.
        """
        fields = self.mode(mode).fields
        if name not in fields:
            raise DatasetError(
                f'Mode "{mode}" has no field "{name}".{nearest(name, fields)} '
                f"Fields: {listed(fields)}."
            )
        return fields[name]

    def row_nbytes(self, mode: str) -> int:
        """Return the bytes of a stored row of a mode, of all its fields; on average."""
        known, total = self.mode(mode), 0
        for field in known.fields.values():
            entries = 1.0
            if field.free_axis:
                entries = sum(p.sizes.get(field.free_axis, 0) for p in known.partitions)
                entries /= max(1, known.rows)
            total += round(field.nbytes * entries)
        return total

    def stored_rows(self, mode: str) -> int:
        """Return the number of stored rows of a mode."""
        return self.mode(mode).rows

    def stored_values(self, mode: str, name: str) -> int:
        """Return how many values the files of a field hold: rows, or entries of a free axis."""
        axis = self.field(mode, name).free_axis
        return int(self.bounds(mode, axis)[-1]) if axis else self.stored_rows(mode)

    def bounds(self, mode: str, axis: str) -> Index:
        """Return the first stored entry of each stored row of a mode, and the end, shape (n + 1).

        Args:
            mode: Name of the mode.
            axis: Name of a free axis.
        """
        known, generation = self.mode(mode), self.manifest.generation
        before, found = self._bounds.get((mode, axis), (generation, np.zeros(1, np.intp)))
        rows = known.rows
        if before != generation or len(found) > rows + 1:
            found = np.zeros(1, np.intp)
        if len(found) <= rows:
            grown = np.empty(rows + 1, np.intp)
            have = len(found) - 1
            grown[: have + 1] = found
            for segment in self.segments(mode, axis + ENDS, have, rows):
                first, count = segment.span.inside(have, rows)
                ends = np.empty(count, "<u8")
                self._read_part(ends, mode, segment, first, {})
                begin = segment.span.start + first
                base = grown[segment.span.start]
                grown[begin + 1 : begin + 1 + count] = base + ends.astype(np.intp)
            if (np.diff(grown[have:]) < 0).any():
                raise DatasetError(
                    f'The ends of the axis "{axis}" of mode "{mode}" in {self.directory} do not '
                    "ascend: they were changed. Restore them from a backup."
                )
            found = grown
        self._bounds[mode, axis] = generation, found
        return found

    def sizes(self, mode: str, stored: Index) -> dict[str, Index]:
        """Return how many entries some stored rows have, by free axis."""
        bounds = {axis: self.bounds(mode, axis) for axis in self.mode(mode).axes}
        return {axis: each[stored + 1] - each[stored] for axis, each in bounds.items()}

    def rows(self, mode: str) -> int:
        """Return the number of rows of a mode."""
        order = self.order(mode)
        return self.mode(mode).rows if order is None else order.rows

    def order(self, mode: str) -> Order | None:
        """Return which stored rows are those of a mode; None if all are, as they were stored."""
        if EPISODES in self.manifest.modes:
            return self.orders.of(mode)
        self.mode(mode)
        return None

    def index(self, mode: str) -> Index | None:
        """Return the stored row of each row of a mode; None if they are the first stored rows."""
        order = self.order(mode)
        return None if order is None else order.index

    def segments(
        self, mode: str, name: str, start: int = 0, stop: int | None = None
    ) -> list[Segment]:
        """Return where the rows of a field are stored, in order, or those that some are in.

        With a free axis, here and below, rows are entries.
        """
        known = self.mode(mode)
        field = known.ends.get(name) or self.field(mode, name)
        if not field.free_axis:
            parts = known.partitions.between(start, known.rows if stop is None else stop)
            return [partition.segment(self.directory, field, span) for partition, span in parts]
        bounds = self.bounds(mode, field.free_axis)
        first = max(0, int(bounds.searchsorted(start, "right")) - 1)
        last = known.rows if stop is None else int(bounds.searchsorted(stop, "left"))
        found = []
        for partition, span in known.partitions.between(first, last):
            begin, end = bounds[[span.start, span.start + span.rows]].tolist()
            found.append(partition.segment(self.directory, field, Span(begin, end - begin)))
        return found

    def read(self, mode: str, name: str, start: int, stop: int) -> Array:
        """Return rows as a new array, shape (stop - start, *field shape).

        With a free axis, it is an array of objects: see `physx_core.packing`.
        """
        field = self.field(mode, name)
        if field.free_axis:
            bounds = self.bounds(mode, field.free_axis)[start : max(start, stop) + 1]
            counts, begin = np.diff(bounds), int(bounds[0]) if len(bounds) else 0
            values = np.empty((int(counts.sum()), *field.entry_shape), field.dtype)
            self.read_into(values, mode, name, begin)
            return split(values, counts)
        if (stop - start) * field.nbytes > BLOCK:
            self.check(mode, name, start, stop)
        out = np.empty((max(0, stop - start), *field.entry_shape), field.numpy_dtype)
        self.read_into(out, mode, name, start)
        return out

    def check(self, mode: str, name: str, start: int = 0, stop: int | None = None) -> None:
        """Check that the files are long enough before memory is allocated for their rows."""
        for segment in self.segments(mode, name, start, stop):
            segment.open()[0].close()

    def read_into(
        self,
        out: Array,
        mode: str,
        name: str,
        start: int,
        checks: dict[int, RowsCheck] | None = None,
    ) -> None:
        """Fill a contiguous array of the field's type with the rows from `start` on.

        Sealed partitions that are read completely are compared with their checksums.

        Args:
            out: Receives the rows.
            mode: Name of the mode.
            name: Name of the field.
            start: First row.
            checks: Checks of partitions that are read in several calls, kept between calls.
        """
        if not self.field(mode, name).nbytes:
            return
        for segment in self.segments(mode, name, start, start + len(out)):
            first, count = segment.span.inside(start, start + len(out))
            rows = out[segment.span.among(first, count, start)]
            self._read_part(rows, mode, segment, first, {} if checks is None else checks)

    def partition_blocks(self, partition: Partition, name: str, start: int) -> Iterator[Array]:
        """Yield a partition's rows from its row `start` on, as `blocks` does for a mode."""
        field = self.field(partition.mode, name)
        segment = partition.segment(self.directory, field)
        count, end = rows_per_block(field.nbytes), partition.rows_of(field)
        buffer = np.empty((min(count, max(0, end - start)), *field.entry_shape), field.numpy_dtype)
        checks: dict[int, RowsCheck] = {}
        for first in range(start, end, count):
            block = buffer[: end - first]
            if field.nbytes:
                self._read_part(block, partition.mode, segment, first, checks)
            yield block

    def blocks(
        self, mode: str, name: str, start: int = 0, stop: int | None = None
    ) -> Iterator[Array]:
        """Yield the rows from `start` on in blocks of about a megabyte, each valid until the next.

        Args:
            mode: Name of the mode.
            name: Name of the field.
            start: First row.
            stop: Row before which to stop; None: after the last row committed so far.
        """
        field = self.field(mode, name)
        end = self.stored_values(mode, name) if stop is None else stop
        count = rows_per_block(field.nbytes)
        buffer = np.empty((min(count, max(0, end - start)), *field.entry_shape), field.numpy_dtype)
        checks: dict[int, RowsCheck] = {}
        for first in range(start, end, count):
            block = buffer[: end - first]
            self.read_into(block, mode, name, first, checks)
            yield block

    def table(self) -> Batch:
        """Return all records of episodes, by field, in the order of writing."""
        total = self.stored_rows(EPISODES)
        return {name: self.read(EPISODES, name, 0, total) for name in self.mode(EPISODES).fields}

    def _read_table(self, name: str, start: int, stop: int) -> Array:
        return self.read(EPISODES, name, start, stop)

    def _read_part(
        self, out: Array, mode: str, segment: Segment, first: int, checks: dict[int, RowsCheck]
    ) -> None:
        """Fill a contiguous array with the rows of a segment from its row `first` on."""
        view = files.as_bytes(out)
        file, offset = segment.open()
        with file:
            segment.read(file, offset + first * segment.field.nbytes, view)
        failed = _add(segment, first, len(out), view, checks)
        if failed is not None:
            self._report(mode, segment, failed)

    def _report(self, mode: str, segment: Segment, check: RowsCheck) -> None:
        """Raise the error for a wrong checksum, unless another process has updated the rows."""
        name, kept = segment.field.name, segment.kept
        if kept is not None and inspect(segment.path).commits[0].base > kept.commit.base:
            return
        for partition in self.mode(mode).partitions:
            mine = partition.path(self.directory, name) == segment.path
            if mine and manifest_file.was_updated(self.directory, partition, name):
                return
        if check.damaged:
            raise DatasetError(
                f"{segment.path} was changed or is damaged: {name_rows(check.damaged)} do not "
                "match their stored digests. Restore it from a backup, or leave these rows out "
                "with `physx verify --repair`."
            )
        raise DatasetError(
            f"{segment.path} was changed or is damaged: its rows do not match their stored "
            "checksum. Restore it from a backup, or set it aside with `physx verify --repair`."
        )


def _add(
    segment: Segment, first: int, count: int, part: memoryview, checks: dict[int, RowsCheck]
) -> RowsCheck | None:
    """Add rows to their segment's check; return it if it fails after the last rows."""
    known = segment.checksum is not None or segment.kept is not None
    start = segment.span.start
    if not known or (first and start not in checks):
        return None
    check = checks.pop(start, None) or RowsCheck(segment)
    check.add(part)
    if first + count == segment.rows:
        return None if check.passed else check
    checks[start] = check
    return None
