"""Statistics of the rows of a mode with episodes: the same bits, wherever the rows are stored.

They are merged over a fixed grid of the rows, in order, each cell from a pass over its own rows. So
those of the first rows can be kept and extended: in memory, and in a file, which the next one to
open the dataset reads instead of the rows.
"""

from __future__ import annotations

import contextlib

from xxhash import xxh3_64, xxh3_64_intdigest

from physx_core.dataset.read.access.columns import ColumnCache
from physx_core.dataset.read.order.order import Order
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.views import FieldView, ModeView
from physx_core.dataset.store import order_file
from physx_core.dataset.store.manifest import Mode
from physx_core.dataset.store.order_file import Prefix
from physx_core.dataset.store.partition.segment import rows_per_block
from physx_core.errors import DatasetError
from physx_core.statistics import RunningStatistics

Statistics = dict[str, RunningStatistics]

_GRID = 4096


def compute_in_order(
    reader: Reader, mode_name: str, order: Order, *, anew: bool = False
) -> Statistics:
    """Return the statistics of a mode's floating-point fields over all rows of an order.

    Args:
        reader: Reads the rows.
        mode_name: Name of the mode.
        order: The order of its rows.
        anew: Whether to read all rows, whatever is known of them.
    """
    known = Prefix() if anew else _known(reader, mode_name, order)
    view, whole, total = ModeView(ColumnCache(reader), mode_name), {}, {}
    for name, field in reader.mode(mode_name).counted_fields.items():
        step = min(_GRID, rows_per_block(field.nbytes))
        whole[name] = _merged(known.whole.get(name, RunningStatistics()))
        for start in range(whole[name].count, order.rows - step + 1, step):
            whole[name].merge(_cell(view[name], start, start + step))
        total[name] = _merged(whole[name], _cell(view[name], whole[name].count, order.rows))
    reader.prefixes[mode_name] = Prefix(order.rows, _state(reader, order, order.rows), whole)
    return total


def store_in_order(reader: Reader) -> None:
    """Store the statistics of all modes with episodes; damaged ones are left out.

    Args:
        reader: Reads the rows; all partitions are sealed.
    """
    found = {}
    for name, mode in reader.manifest.modes.items():
        if (order := reader.order(name)) is not None:
            with contextlib.suppress(DatasetError):
                compute_in_order(reader, name, order)
                whole, key = reader.prefixes[name].whole, _stored_key(mode, order, order.rows)
                if key is not None:
                    found[name] = Prefix(order.rows, key, whole)
    if found:
        order_file.write(reader.directory, found)


def _known(reader: Reader, mode_name: str, order: Order) -> Prefix:
    """Return the statistics of the first rows that are known already."""
    known = reader.prefixes.get(mode_name)
    if known is not None and known.key == _state(reader, order, known.rows):
        return known
    mode = reader.mode(mode_name)
    stored = order_file.read(reader.directory, {mode_name: mode}).get(mode_name, Prefix())
    steps = {n: min(_GRID, rows_per_block(of.nbytes)) for n, of in mode.counted_fields.items()}
    fits = all(s.count % steps[n] == 0 and s.count <= stored.rows for n, s in stored.whole.items())
    is_part = 0 < stored.rows <= order.rows
    if fits and is_part and stored.key == _stored_key(mode, order, stored.rows):
        return stored
    return Prefix()


def _cell(view: FieldView, start: int, stop: int) -> RunningStatistics:
    found = RunningStatistics()
    found.update(view[start:stop])
    return found


def _merged(*parts: RunningStatistics) -> RunningStatistics:
    found = RunningStatistics()
    for part in parts:
        found.merge(part)
    return found


def _state(reader: Reader, order: Order, rows: int) -> int:
    """Return what identifies the first rows while this process has the dataset open."""
    content = repr((reader.manifest.generation, rows)).encode()
    return xxh3_64_intdigest(content + order.first_places(rows).tobytes())


def _stored_key(mode: Mode, order: Order, rows: int) -> int | None:
    """Return what identifies the first rows for good; None while some have no checksums."""
    places = order.first_places(rows)
    last = int(places.sum(axis=0).max(initial=0))
    key = xxh3_64(places.tobytes())
    for partition, span in zip(mode.partitions, mode.spans, strict=True):
        if span.start < last and span.rows:
            digest = partition.digest(mode.fields)
            if not digest:
                return None
            key.update(repr((digest, span)).encode())
    return key.intdigest()
