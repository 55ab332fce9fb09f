"""The records of the episodes that count, with their rows at other addresses."""

from __future__ import annotations

import numpy as np

from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.read.order.order import Order
from physx_core.dataset.store.episode_record import OPEN, EpisodeStatus
from physx_core.typing import Batch, Index


def records_at(
    order: Order, places: Index, addresses: Addresses, table: Batch, *, is_open: bool
) -> Batch:
    """Return the rows of the table for the episodes of a mode that count, by field.

    An episode has one for each run of its rows with consecutive addresses.

    Args:
        order: The episodes that count.
        places: Where the mode's records are in the table.
        addresses: Where the rows will be.
        table: The rows of the table now.
        is_open: Whether the last episode is a stream that takes further rows.
    """
    known, found = order.episodes, order.found
    if not len(known.rows):
        return {name: column[:0] for name, column in table.items()}
    entry, part, first, rows = _pieces(order, addresses)
    is_range, is_stream = known.numbers[entry] > 1, known.status[entry] == EpisodeStatus.STREAM
    is_last = np.append(np.diff(entry) > 0, True)
    of = places[found.last]
    numbers = known.numbers / table["count"][of]
    begins = np.cumsum(found.parts) - found.parts
    seconds = np.add.reduceat(table["seconds"][places[found.record]], begins) * numbers
    if is_open and is_stream[-1]:
        first[-1], rows[-1] = (first[-1] if rows[-1] else addresses.end), OPEN
    before = np.cumsum(rows) - rows
    before -= before[entry.searchsorted(entry)]
    changed = {
        "episode": known.episode[entry] + np.where(is_range, before, 0),
        "count": np.where(is_range, rows, 1),
        "first_row": first,
        "rows": rows,
        "part": np.where(is_range | is_stream, 0, part),
        "status": np.where(is_range | is_last, known.status[entry], EpisodeStatus.MORE),
        "seconds": np.where(is_last, seconds[entry], 0.0),
    }
    return {
        name: changed.get(name, column[of][entry]).astype(column.dtype)
        for name, column in table.items()
    }


def _pieces(order: Order, addresses: Addresses) -> tuple[Index, Index, Index, Index]:
    """Return for each piece its episode, its number there, its first address and its rows.

    The rows of a stream are one piece, which spans all their addresses.
    """
    known, (runs, run_addresses) = order.episodes, addresses.runs
    stop = known.first + known.rows
    run = runs.searchsorted(known.first, "right") - 1
    last = np.maximum(runs.searchsorted(stop) - 1, run)
    stream = known.status == EpisodeStatus.STREAM
    pieces = np.where(stream, 1, last - run + 1)
    entry = np.repeat(np.arange(len(run)), pieces)
    part = np.arange(len(entry)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    begins, ends = runs[run[entry] + part], np.append(runs[1:], order.rows)[run[entry] + part]
    start = np.maximum(known.first[entry], begins)
    first = run_addresses[run[entry] + part] + start - begins
    rows = np.minimum(stop[entry], ends) - start
    end = run_addresses[last] + stop - runs[last]
    return entry, part, first, np.where(stream[entry], end[entry] - first, rows)
