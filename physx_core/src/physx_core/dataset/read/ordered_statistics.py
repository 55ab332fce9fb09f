"""Statistics of rows of a mode: the same bits, wherever the rows are stored.

They are merged from cells, in order of the rows, each from its own rows alone: an episode of many
rows is a cell, and other rows are divided evenly. Which cells these are depends on the rows and the
table of episodes alone. So the cells of recorded episodes can be kept, in memory and in a file, and
the statistics of any of the episodes take no pass over their rows.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_64_intdigest

from physx_core.dataset.read.access.columns import ColumnCache
from physx_core.dataset.read.mode_rows import ModeRows
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.shuffling import scramble
from physx_core.dataset.store import order_file
from physx_core.dataset.store.episode_record import EpisodeStatus
from physx_core.dataset.store.manifest import Partition
from physx_core.dataset.store.order_file import KeptCells, nothing
from physx_core.dataset.store.partition.segment import rows_per_block
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.normalization import Measured
from physx_core.statistics import Cells, RunningStatistics
from physx_core.typing import Index

Statistics = dict[str, RunningStatistics]
Keys = NDArray[np.uint64]

_FEWEST, _MOST = 32, 4096
"""Rows of an episode that is a cell, and of a cell of other rows, of small values."""
_LARGE_CELL = 2**26
"""Bytes of a cell of more than the fewest rows, of large values."""
_KEPT = 2**25
"""Bytes of the cells of a field. Cells of more rows are made if there would be more."""
_ARRAYS, _NUMBER = 4, 8
_FREE_ROWS = 256
"""Rows of free axes that are read at once."""
_NO: Index = np.zeros(0, np.intp)


def compute_in_order(reader: Reader, mode_name: str, *, anew: bool = False) -> Statistics:
    """Return the statistics of a mode's floating-point fields over all rows of its episodes.

    Args:
        reader: Reads the rows.
        mode_name: Name of the mode.
        anew: Whether to read all rows, whatever is known of them.
    """
    known, fields = ModeRows(ColumnCache(reader), mode_name), reader.mode(mode_name).counted_fields
    if anew:
        for name, field in fields.items():
            reader.cells[mode_name, name] = reader.stored_cells[mode_name, name] = nothing(field)
    return {
        name: compute_of_rows(known, kept_of(field), *all_rows(known))
        for name, field in fields.items()
    }


def compute_of_rows(
    known: ModeRows, of: Measured, starts: Index, counts: Index
) -> RunningStatistics:
    """Return the statistics of some rows.

    Args:
        known: The rows of the mode.
        of: The field, and what of it.
        starts: First rows of the ranges that they consist of, ascending.
        counts: Numbers of rows of these ranges, which do not overlap.
    """
    field = known.fields[of.field]
    cells = _divide(known, field, starts, counts)
    special = of.log or of.since or of.pooled != field.pooled
    if known.order is None or special:
        return _read(known, of, cells).merged()
    return _Keeper(known, of).find(cells).merged()


def store_in_order(reader: Reader) -> None:
    """Store the cells of all modes with episodes; those of damaged modes are left out.

    Args:
        reader: Reads the rows; all partitions are sealed.
    """
    found: dict[tuple[str, str], KeptCells] = {}
    for name, mode in reader.manifest.modes.items():
        if reader.order(name) is None:
            continue
        with contextlib.suppress(DatasetError):
            known = ModeRows(ColumnCache(reader), name)
            compute_in_order(reader, name)
            found |= {
                (name, field): kept
                for field, of in mode.counted_fields.items()
                if len((kept := _Keeper(known, kept_of(known.fields[field])).stored()).keys)
            }
    if found:
        order_file.write(reader.directory, found)


class _Division(NamedTuple):
    """Which rows are the cells of some rows, in order.

    Attributes:
        start: First row of each cell, shape (cells,).
        size: Number of its rows.
        scattered: The rows of those cells whose rows do not follow one another.
    """

    start: Index
    size: Index
    scattered: Mapping[int, Index]

    def take(self, chosen: Index) -> _Division:
        """Return some of the cells."""
        now = {old: new for new, old in enumerate(chosen.tolist())} if self.scattered else {}
        scattered = {now[old]: rows for old, rows in self.scattered.items() if old in now}
        return _Division(self.start[chosen], self.size[chosen], scattered)

    def rows(self, cell: int) -> Index:
        """Return the rows of a cell."""
        start = int(self.start[cell])
        return self.scattered.get(cell, np.arange(start, start + int(self.size[cell])))


def _divide(known: ModeRows, field: Field, starts: Index, counts: Index) -> _Division:
    """Return the cells of ranges of rows."""
    if not len(starts):
        return _Division(_NO, _NO, {})
    starts, stops = _joined(starts, starts + counts)
    fewest, size = _FEWEST, _ARRAYS * _NUMBER * math.prod(field.statistics_shape)
    while known.count * size > fewest * _KEPT:
        fewest *= 2
    most = max(fewest, min(_MOST, _LARGE_CELL // max(1, field.nbytes)))
    begin, end = _long_episodes(known, fewest)
    place = np.maximum(starts.searchsorted(begin, "right") - 1, 0)
    inside = (begin >= starts[place]) & (end <= stops[place])
    begin, end = begin[inside], end[inside]
    # What lies between these episodes, and of this what follows one another without one of them.
    other, other_end = np.sort(np.append(starts, end)), np.sort(np.append(begin, stops))
    is_some = other < other_end
    other, other_end = other[is_some], other_end[is_some]
    run = begin.searchsorted(other, "right")
    cuts = np.flatnonzero(np.diff(run)) + 1
    chunks: list[Index] = []
    for these, those in zip(np.split(other, cuts), np.split(other_end, cuts), strict=True):
        rows = np.concatenate(
            [np.arange(*each) for each in zip(these, those, strict=True)] or [_NO]
        )
        chunks += np.split(rows, np.arange(most, len(rows), most)) if len(rows) else []
    if not chunks:
        return _Division(begin, end - begin, {})
    start = np.append(begin, [chunk[0] for chunk in chunks]).astype(np.intp)
    count = np.append(end - begin, [len(chunk) for chunk in chunks]).astype(np.intp)
    order = np.argsort(start, kind="stable")
    place_of = np.argsort(order)[len(begin) :].tolist()
    scattered = {
        place: chunk
        for place, chunk in zip(place_of, chunks, strict=True)
        if chunk[-1] - chunk[0] != len(chunk) - 1
    }
    return _Division(start[order], count[order], scattered)


def _joined(starts: Index, stops: Index) -> tuple[Index, Index]:
    """Return ranges in which those that follow one another are one."""
    apart = starts[1:] != stops[:-1]
    return starts[np.append(True, apart)], stops[np.append(apart, True)]


def _long_episodes(known: ModeRows, fewest: int) -> tuple[Index, Index]:
    """Return the first rows of episodes with at least some rows, and the rows after their last."""
    if known.order is None:
        return _NO, _NO
    found = known.order.episodes
    stops = found.first + found.rows
    is_long = (found.rows >= fewest) & (found.numbers == 1) & (stops <= known.count)
    is_long &= found.status != EpisodeStatus.STREAM
    return found.first[is_long], stops[is_long]


def _read(known: ModeRows, of: Measured, cells: _Division) -> Cells:
    """Return the statistics of cells, computed from their rows."""
    field = known.fields[of.field]
    if field.free_axis:
        return _read_entries(known, of, cells)
    step, ends, first = rows_per_block(field.nbytes), np.cumsum(cells.size), 0
    found = [nothing(field, of.pooled).cells]
    while first < len(ends):
        read = int(ends[first] - cells.size[first])
        last = max(first + 1, int(ends.searchsorted(read + step, "right")))
        rows = np.concatenate([cells.rows(cell) for cell in range(first, last)])
        blocks = (rows[begin : begin + step] for begin in range(0, len(rows), step))
        values = (of.of({n: known.gather(n, block) for n in of.names}) for block in blocks)
        if len(rows) <= step:
            found.append(Cells.of(next(values), cells.size[first:last], of.pooled))
        else:
            found.append(Cells.one(values, of.pooled))
        first = last
    return Cells.joined(found)


def _read_entries(known: ModeRows, of: Measured, cells: _Division) -> Cells:
    """Return the statistics of the entries of cells."""
    found = [nothing(known.fields[of.field], of.pooled).cells]
    for cell in range(len(cells.size)):
        rows = cells.rows(cell)
        blocks = (rows[begin : begin + _FREE_ROWS] for begin in range(0, len(rows), _FREE_ROWS))
        values = [of.of({n: known.entries(n, block)[0] for n in of.names}) for block in blocks]
        found.append(Cells.one(values, of.pooled) if any(map(len, values)) else found[0].empty())
    return Cells.joined(found)


class _Keeper:
    """Finds the statistics of cells of a field of a mode with episodes, or reads and keeps them."""

    def __init__(self, known: ModeRows, of: Measured) -> None:
        self._known, self._of, self._reader = known, of, known.reader
        self._mode = self._reader.mode(known.mode)
        self._field, self._place = self._mode.fields[of.field], (known.mode, of.field)

    def find(self, cells: _Division) -> Cells:
        """Return the statistics of some cells, which are kept from now on."""
        place, parts, count = np.full(len(cells.size), -1), [], 0
        live = self._reader.cells.get(self._place, nothing(self._field))
        for kept, identify in ((self._stored(), self._lasting), (live, self._live)):
            missing = np.flatnonzero(place < 0)
            if len(kept.keys) and len(missing):
                rest = cells.take(missing)
                there = kept.places(self._keys(rest, identify), self._counts(rest))
                place[missing] = np.where(there < 0, -1, count + there)
                parts.append(kept.cells)
                count += len(kept.keys)
        missing = np.flatnonzero(place < 0)
        if len(missing) or not parts:
            rest = cells.take(missing)
            parts.append(_read(self._known, self._of, rest))
            place[missing] = count + np.arange(len(missing))
            self._keep(live, KeptCells.of(self._keys(rest, self._live), parts[-1]))
        return (parts[0] if len(parts) == 1 else Cells.joined(parts)).take(place)

    def _counts(self, cells: _Division) -> Index | None:
        """Return the numbers of rows of cells; None: they are counted by entries."""
        return None if self._field.free_axis else cells.size

    def _keep(self, known: KeptCells, new: KeptCells) -> None:
        """Keep cells in memory, beside those that are known unless these are too large."""
        if known.cells.mean.nbytes * _ARRAYS < _KEPT:
            keys = np.concatenate([known.keys, new.keys])
            new = KeptCells.of(keys, Cells.joined([known.cells, new.cells]))
        self._reader.cells[self._place] = new

    def stored(self) -> KeptCells:
        """Return the statistics of all cells of the mode that can be stored."""
        cells = _divide(self._known, self._field, *all_rows(self._known))
        return KeptCells.of(self._keys(cells, self._lasting), self.find(cells))

    def _stored(self) -> KeptCells:
        reader = self._reader
        if self._place not in reader.stored_cells:
            reader.stored_cells |= order_file.read(reader.directory, reader.manifest.modes)
        return reader.stored_cells.setdefault(self._place, nothing(self._field))

    def _live(self, partition: Partition) -> int:
        """Return what identifies a partition while this process has the dataset open."""
        generation = self._reader.manifest.generation
        return xxh3_64_intdigest(repr((*partition.key, generation)).encode())

    def _lasting(self, partition: Partition) -> int:
        """Return what identifies the rows of a partition for good; 0 while nothing does."""
        return int(partition.digest(self._mode.fields) or "0", 16)

    def _keys(self, cells: _Division, identify: Callable[[Partition], int]) -> Keys:
        """Return what identifies the rows of cells by where they are; 0: nothing does."""
        order = self._known.order
        found = np.zeros(len(cells.start), np.uint64)
        if order is None or not len(cells.start):
            return found
        parts = self._mode.with_rows
        ends = np.cumsum([part.rows for part in parts])
        begins, who = ends - np.diff(ends, prepend=0), np.array([*map(identify, parts)], np.uint64)
        last = cells.start + cells.size - 1
        first_stored, last_stored = order.stored(cells.start), order.stored(last)
        part = ends.searchsorted(first_stored, "right")
        single = order.piece(cells.start) == order.piece(last)
        single &= part == ends.searchsorted(last_stored, "right")
        offset = (first_stored - begins[part]).astype(np.uint64)
        counts = cells.size.astype(np.uint64)
        found = scramble(scramble(scramble(offset, 1) ^ counts, 2) ^ who[part], 3)
        found[who[part] == 0] = 0
        for cell in np.flatnonzero(~single).tolist():
            found[cell] = self._key_of_pieces(cells, cell, begins, ends, who)
        found[list(cells.scattered)] = 0
        return found

    def _key_of_pieces(
        self, cells: _Division, cell: int, begins: Index, ends: Index, who: Keys
    ) -> int:
        """Return what identifies the rows of a cell that are stored in several places."""
        assert self._known.order is not None
        start = int(cells.start[cell])
        first, count = self._known.order.places_of(start, start + int(cells.size[cell]))
        part = ends.searchsorted(first, "right")
        to = ends.searchsorted(first + count - 1, "right")
        over = np.flatnonzero(to > part)  # pieces in several partitions
        several = [np.arange(part[piece], to[piece] + 1) for piece in over.tolist()]
        used = np.unique(np.concatenate([part, *several]))
        if not who[used].all():
            return 0
        columns = (
            first - begins[part],
            count,
            used.searchsorted(part),
            who[used],
            ends[used] - begins[used],
        )
        return xxh3_64_intdigest(b"".join(np.ascontiguousarray(c).tobytes() for c in columns))


def all_rows(known: ModeRows) -> tuple[Index, Index]:
    """Return all rows as ranges."""
    count = min(1, known.count)
    return np.zeros(count, np.intp), np.full(count, known.count)


def kept_of(field: Field) -> Measured:
    """Return which statistics of a field are kept."""
    return Measured(field.name, field.pooled, log=False)
