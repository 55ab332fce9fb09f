"""EpisodeReading: what a dataset tells of its episodes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.dataset.read.access.columns import ColumnCache
from physx_core.dataset.read.episodes import Episode, find_episodes
from physx_core.dataset.read.mode_rows import ModeRows
from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.read.order.order import Order
from physx_core.dataset.read.order.records import RecordedEpisodes
from physx_core.dataset.read.order.rewriting import records_at
from physx_core.dataset.read.progress import Progress, find_progress
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.views import ModeView, row_numbers
from physx_core.dataset.store import failure_file
from physx_core.dataset.store.episode_record import EpisodeStatus
from physx_core.dataset.store.episode_table import EPISODES, TABLE_FIELDS, has_table
from physx_core.dataset.store.failure_file import FailedEpisode
from physx_core.dataset.store.manifest import Mode, Partition, Partitions
from physx_core.fields import Field
from physx_core.typing import Array, Batch, Index


class EpisodeReading(ABC):
    """The part of a `Dataset` that tells of episodes.

    Attributes:
        directory: The folder.
    """

    directory: Path
    _reader: Reader
    _columns: ColumnCache

    @abstractmethod
    def _prepare_reading(self) -> None:
        """Check that the dataset is open, and commit pending samples."""

    def episodes(self, mode: str) -> list[Episode]:
        """Return the trajectories of a mode, each with the numbers of its rows in temporal order.

        A trajectory ends when an environment calls `Environment.new_episode`, when `check_sample`
        rejects a sample, and when another run begins.

        Raises:
            DatasetError: If there is no such mode, or its rows do not record where trajectories
                begin.
        """
        self._prepare_reading()
        return find_episodes(ModeRows(self._columns, mode))

    def recorded_episodes(self, mode: str) -> RecordedEpisodes | None:
        """Return the recorded episodes of a mode, in order; None if its rows have no records.

        Raises:
            DatasetError: If there is no such mode, or the table of episodes is damaged.
        """
        order = self._order(mode)
        return None if order is None else order.episodes

    def failed_episodes(self, mode: str) -> list[FailedEpisode]:
        """Return the episodes of a mode that are recorded as failed, in order, and why they did.

        Raises:
            DatasetError: If there is no such mode, or the table of episodes is damaged.
        """
        found = self.recorded_episodes(mode)
        if found is None:
            return []
        known = {f[:3]: f for f in failure_file.read(self.directory)}
        failed = found.status == EpisodeStatus.FAILED
        keys = zip(found.campaign[failed].tolist(), found.episode[failed].tolist(), strict=True)
        return [known.get((mode, *key), FailedEpisode(mode, *key, "")) for key in keys]

    def episode_table(self, modes: Sequence[str]) -> Batch:
        """Return the records of the episodes of some modes that count, by field.

        They are those of `physx_core.dataset.store.episode_table`, with the parameters, but one for
        each entry of `recorded_episodes`; ``first_row`` is the number of its first row.

        Args:
            modes: Names of the modes; those without records are left out.

        Raises:
            DatasetError: If there is no such mode, or no table of episodes, or it is damaged.
        """
        self._prepare_reading()
        table = self._reader.table()
        parts = [{name: column[:0] for name, column in table.items()}]
        for mode in modes:
            order = self._reader.order(mode)
            if order is not None and len(order.last_records):
                whole = Addresses(Mode({}, Partitions([Partition(mode, "", 0, 0, order.rows)])))
                places = self._reader.orders.places(mode)
                parts.append(records_at(order, places, whole, table, is_open=False))
        return {name: np.concatenate([part[name] for part in parts]) for name in table}

    def recorded_values(self, mode: str, entries: Index) -> Batch:
        """Return the parameters and fields of some recorded episodes, by name; empty without any.

        Args:
            mode: Name of a mode with records.
            entries: Which entries of `recorded_episodes`, shape (n,).

        Returns:
            Arrays of shape (n, *shape of the parameter or field).

        Raises:
            DatasetError: If there is no such mode, or the table of episodes is damaged.
        """
        order = self._order(mode)
        if order is None or not len(entries):
            return {}
        names = self._reader.mode(EPISODES).fields.keys() - {field.name for field in TABLE_FIELDS}
        return self._values(mode, order, names, entries)

    @property
    def episode_fields(self) -> dict[str, Field]:
        """The fields that each independent episode has once, by name."""
        mode = self._reader.manifest.modes.get(EPISODES)
        fields = mode.fields if mode is not None and self.has_episodes else {}
        return {name: field for name, field in fields.items() if field.role == "episode"}

    def episode_values(self, mode: str, name: str, rows: Any) -> Array:
        """Return what the episode of each row has once: a parameter, or a field of its own.

        Args:
            mode: Name of a mode of independent episodes.
            name: Name of a field of the mode ``episodes``.
            rows: A row's number, numbers of shape (n,), or a slice.

        Returns:
            Shape (n, *field shape); 0 for rows of streams.

        Raises:
            DatasetError: If there is no such mode or field, the mode has no episodes, or the table
                of episodes is damaged.
            IndexError: If there is no such row.
        """
        self._prepare_reading()
        known = ModeRows(self._columns, mode)
        return known.episode_values(name, row_numbers(rows, known.count))

    def progress(self, mode: str) -> list[Progress]:
        """Return how many episodes of each campaign of a mode have ended; none without records.

        Unlike `recorded_episodes`, all count that another process has recorded so far.

        Raises:
            DatasetError: If there is no such mode, or the table of episodes is damaged.
        """
        if self._order(mode) is None:
            return []
        orders = self._reader.orders
        found, records = orders.all(mode), orders.records(mode)
        if not len(records.rows):
            return []
        seconds = self._reader.read(EPISODES, "seconds", 0, self._reader.stored_rows(EPISODES))
        return find_progress(found, records, seconds[orders.places(mode)])

    @property
    def has_episodes(self) -> bool:
        """Whether the mode ``episodes`` is the table of episodes."""
        return has_table(self._reader.manifest)

    def _order(self, mode: str) -> Order | None:
        """Return the order of a mode's rows; None if they have no records."""
        self._prepare_reading()
        order = self._reader.order(mode)
        if order is None:
            self._reader.mode(mode)  # there must be one
        return order

    def _values(self, mode: str, order: Order, names: Iterable[str], entries: Index) -> Batch:
        """Return values by name from the records of some episodes of a mode."""
        places = self._reader.orders.places(mode)[order.last_records[entries]]
        table = ModeView(self._columns, EPISODES)
        return {name: table[name][places] for name in names}
