"""Imports independent episodes with their records, as exports have them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from physx_core.config import MODES
from physx_core.dataset import (
    TABLE_FIELDS,
    Dataset,
    EpisodeRecord,
    EpisodeStatus,
    rows_per_block,
)
from physx_core.errors import ConfigError, SampleError
from physx_core.fields import Field
from physx_core.typing import Batch
from physx_formats.errors import ExchangeError
from physx_formats.format import Columns
from physx_formats.table import BLOCK, Advance

_OWN = {field.name for field in TABLE_FIELDS}


def split_records(path: Path, table: Batch, lengths: Mapping[str, int]) -> dict[str, Batch]:
    """Return the records of each mode that has some, and check that they cover its rows.

    Args:
        path: The file, for messages.
        table: The table of episodes, by field.
        lengths: Number of rows of each mode.

    Raises:
        ExchangeError: If the records do not fit the rows.
    """
    found = {}
    for name, length in lengths.items():
        about = table["mode_index"] == (MODES.index(name) if name in MODES else -1)
        if not about.any():
            continue
        found[name] = {key: column[about] for key, column in table.items()}
        rows, first = found[name]["rows"], found[name]["first_row"]
        fits = (rows >= 0).all() and (rows <= length).all() and rows.sum() == length
        if not fits or ((np.cumsum(rows) - rows != first) & (rows > 0)).any():
            raise ExchangeError(f'The records of episodes in {path} do not fit the mode "{name}".')
    return found


def copy_stream(
    dataset: Dataset, mode: str, fields: Mapping[str, Field], columns: Columns, advance: Advance
) -> int:
    """Store the rows of a mode without records, and return their number."""
    dataset.define_fields(mode, fields.values())
    rows = next(iter(columns.values())).shape[0]
    step = rows_per_block(sum(field.nbytes for field in fields.values()), BLOCK)
    for start in range(0, rows, step):
        count = min(step, rows - start)
        block = {name: column.read(start, count) for name, column in columns.items()}
        try:
            dataset.append(mode, block)
        except SampleError as error:
            error.add_note(f"in rows {start} to {start + count - 1}")
            raise
        advance(sum(array.nbytes for array in block.values()))
    return rows


class EpisodeCopier:
    """Stores the rows of a mode with their records, a few megabytes at once."""

    def __init__(
        self,
        dataset: Dataset,
        mode: str,
        fields: Mapping[str, Field],
        columns: Columns,
        table: Mapping[str, Field],
        advance: Advance,
        reasons: Mapping[tuple[int, int], str] | None = None,
    ) -> None:
        """Prepare the mode.

        Args:
            dataset: Receives the rows.
            mode: Name of the mode.
            fields: Its fields.
            columns: Its columns, read from the first row on.
            table: The fields of the records.
            advance: Called with the number of bytes stored.
            reasons: Why episodes have failed, by campaign and number.
        """
        dataset.define_fields(mode, fields.values())
        self._reasons = reasons or {}
        self._dataset, self._mode, self._columns = dataset, mode, columns
        self._step = rows_per_block(sum(field.nbytes for field in fields.values()), BLOCK)
        self._advance, self._done = advance, 0
        self._once = [field for field in table.values() if field.role == "episode"]
        known = dataset.recorded_episodes(mode)
        self._shift = int(dataset.num_samples(mode) > 0)
        if known is not None:
            self._shift = int(known.campaign.max(initial=-1)) + 1

    def copy(self, records: Batch) -> int:
        """Store rows and records, and return the number of rows.

        Raises:
            ExchangeError: If a record contradicts itself.
        """
        try:
            waiting: list[EpisodeRecord] = []
            for number in range(len(records["rows"])):
                record = {name: column[number] for name, column in records.items()}
                if record["status"] == EpisodeStatus.STREAM:
                    self._store(waiting)
                    self._store_stream(int(record["rows"]))
                    continue
                for part in self._parts(record):
                    if sum(each.rows for each in waiting) + part.rows > self._step:
                        self._store(waiting)
                    waiting.append(part)
            self._store(waiting)
        except (ConfigError, ValueError) as error:
            raise ExchangeError(f"A record of an episode cannot be stored: {error}") from error
        return self._done

    def _parts(self, record: Batch) -> Iterator[EpisodeRecord]:
        """Yield the record of episodes, or several if they have many rows: parts, or ranges."""
        rows, is_range = int(record["rows"]), record["count"] > 1
        taken = [*_OWN, *(field.name for field in self._once)]
        status = EpisodeStatus(int(record["status"]))
        for part, start in enumerate(range(0, max(rows, 1), self._step)):
            size, is_last = min(self._step, rows - start), start + self._step >= rows
            yield EpisodeRecord(
                campaign=int(record["campaign"]) + self._shift,
                episode=int(record["episode"]) + (start if is_range else 0),
                count=size if is_range else 1,
                rows=size,
                part=0 if is_range else part,
                status=status if is_last or is_range else EpisodeStatus.MORE,
                seconds=float(record["seconds"]) if is_last else 0.0,
                parameters={name: value for name, value in record.items() if name not in taken},
                fields={} if is_range else {each.name: record[each.name] for each in self._once},
                reason=self._reasons.get((int(record["campaign"]), int(record["episode"])), ""),
            )

    def _store(self, waiting: list[EpisodeRecord]) -> None:
        """Store episodes, and forget them."""
        rows = self._read(sum(each.rows for each in waiting))
        self._dataset.append_episodes(self._mode, rows, waiting, episode_fields=self._once)
        waiting.clear()

    def _store_stream(self, rows: int) -> None:
        while rows:
            count = min(rows, self._step)
            self._dataset.append(self._mode, self._read(count))
            rows -= count

    def _read(self, count: int) -> Batch:
        """Return the next rows."""
        start, self._done = self._done, self._done + count
        block = {name: column.read(start, count) for name, column in self._columns.items()}
        self._advance(sum(array.nbytes for array in block.values()))
        return block
