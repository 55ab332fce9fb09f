"""Splits a mode into parts, which are lists of row numbers; nothing is copied."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Unpack

import numpy as np

from physx_core.dataset.read.episodes import find_episodes
from physx_core.dataset.read.mode_rows import ModeRows, Snapshot
from physx_core.dataset.read.order.order import Order
from physx_core.dataset.read.sampling import BatchOptions, BatchReader
from physx_core.dataset.read.views import FieldView, ModeView
from physx_core.dataset.store.manifest import has_statistics
from physx_core.dataset.store.partition.segment import rows_per_block
from physx_core.errors import ConfigError, DatasetError
from physx_core.fields import Field
from physx_core.statistics import Normalization, RunningStatistics
from physx_core.typing import Array, Batch, Index

_EXACT = 1e-9


class SubsetField:
    """The rows of one field in a subset; indexed like a `FieldView`, with copies as results.

    Attributes:
        field: The field.
    """

    def __init__(self, view: FieldView, rows: Index) -> None:
        self.field = view.field
        self._view, self._rows = view, rows

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, *field shape)."""
        return (len(self._rows), *(self.field.shape or ()))

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values."""
        return self._view.dtype

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, rows: Any) -> Array:
        chosen = self._rows[rows]
        return self._view[int(chosen) if chosen.ndim == 0 else chosen]


class Subset:
    """Some rows of a mode, in the order of writing.

    Its rows existed when the mode was split; later rows are in no part.

    Attributes:
        mode: Name of the mode.
    """

    def __init__(self, view: ModeView, rows: Index) -> None:
        self.mode, self._rows = view.mode, rows
        self._view, self._reader = view, view.columns.reader
        self._order = self._reader.order(self.mode)
        self._stored = [partition.key for partition in self._reader.mode(self.mode).with_rows]

    @property
    def rows(self) -> Index:
        """Numbers of the rows in the mode, ascending, shape (rows,).

        They change when an earlier independent episode is stored.

        Raises:
            DatasetError: If some of the rows belong to an episode that was replaced, or the mode
                was compacted.
        """
        order = self._reader.order(self.mode)
        if order is not self._order:
            stored = [partition.key for partition in self._reader.mode(self.mode).with_rows]
            if stored[: len(self._stored)] != self._stored:
                raise DatasetError(
                    "Rows were removed, or compacted, since the mode was split: split it again."
                )
            self._rows = _renumbered(self._rows, self._order, order)
            self._order = order
        return self._rows

    @property
    def num_samples(self) -> int:
        """Number of rows."""
        return len(self.rows)

    @property
    def fields(self) -> dict[str, Field]:
        """The fields by name."""
        return {name: view.field for name, view in self._view.items()}

    def __getitem__(self, name: str) -> SubsetField:
        return SubsetField(self._view[name], self.rows)

    def batches(self, batch_size: int, **options: Unpack[BatchOptions]) -> Iterator[Batch]:
        """Iterate over the rows in batches; options and errors are those of `Dataset.batches`.

        ``normalize=True`` uses `normalization`, which is computed from these rows alone.
        """
        if options.get("normalize") is True:
            options["normalize"] = self.normalization()
        return iter(BatchReader(self._view.columns, self.mode, batch_size, self.rows, **options))

    def normalization(self) -> dict[str, Normalization]:
        """Compute the normalization of the floating-point fields from these rows, in one pass.

        Raises:
            DatasetError: If a partition is missing or damaged.
        """
        return {
            name: self._statistics(name, field).normalization()
            for name, field in self.fields.items()
            if has_statistics(field)
        }

    def _statistics(self, name: str, field: Field) -> RunningStatistics:
        statistics, view = RunningStatistics(), self._view[name]
        step = rows_per_block(field.nbytes)
        for start in range(0, int(self.rows[-1]) + 1, step):
            first, last = np.searchsorted(self.rows, (start, start + step))
            if first < last:
                statistics.update(view[start : start + step][self.rows[first:last] - start])
        return statistics

    def __repr__(self) -> str:
        return f"<{self.num_samples} samples of {self.mode}>"


def split(
    view: ModeView, total: int, shares: Mapping[str, float], by: str, seed: int
) -> dict[str, Subset]:
    """Return parts of the first `total` rows of a mode: see `Dataset.split`."""
    _check(shares, by)
    random = np.random.default_rng(seed)
    if by == "row":
        rows = random.permutation(total)
        ends = [round(end * total) for end in _ends(shares)]
    else:
        rows, ends = _shuffle_episodes(view, total, shares, random)
    parts = {}
    for name, start, stop in zip(shares, [0, *ends], ends, strict=False):
        if start >= stop:
            raise ConfigError(
                f'The part "{name}" would be empty: there are {total} samples of mode '
                f'"{view.mode}".'
            )
        parts[name] = Subset(view, np.sort(rows[start:stop]))
    return parts


def _check(shares: Mapping[str, float], by: str) -> None:
    if by not in ("row", "episode"):
        raise ConfigError(f'by is {by!r} but must be "row" or "episode".')
    values = np.array(list(shares.values()), np.float64)
    if not values.size or not (values > 0).all() or values.sum() > 1 + _EXACT:
        raise ConfigError(
            f"The shares are {dict(shares)} but must be positive and add up to at most 1."
        )


def _ends(shares: Mapping[str, float]) -> list[float]:
    """Return where each part ends, as a share of all rows; 1 is exact despite rounding."""
    ends = np.cumsum(list(shares.values()))
    return [1.0 if abs(end - 1) < _EXACT else float(end) for end in ends]


def _shuffle_episodes(
    view: ModeView, total: int, shares: Mapping[str, float], random: np.random.Generator
) -> tuple[Array, list[int]]:
    """Return all rows, shuffled by trajectory, and where each part ends among them.

    Each part has at least one trajectory and ends with the one that brings it closest to its
    share of the rows.
    """
    episodes = find_episodes(
        ModeRows(
            view.columns, view.mode, Snapshot(total, view.columns.reader.orders.count(view.mode))
        )
    )
    if len(episodes) < len(shares):
        raise ConfigError(
            f'Mode "{view.mode}" has {len(episodes)} trajectories, which cannot be split into '
            f'{len(shares)} parts by episode. Split by="row".'
        )
    order = random.permutation(len(episodes))
    ends = np.cumsum([len(episodes[number].rows) for number in order])
    counts: list[int] = []
    for number, share in enumerate(_ends(shares)):
        nearest = int(np.abs(ends - share * total).argmin()) + 1
        most = len(episodes) - (len(shares) - number - 1)
        counts.append(min(max(nearest, (counts or [0])[-1] + 1), most))
    rows = np.concatenate([episodes[number].rows for number in order])
    return rows, [int(ends[count - 1]) for count in counts]


def _renumbered(rows: Index, before: Order | None, now: Order | None) -> Index:
    """Return the numbers that rows have in another order of the same stored rows."""
    stored = rows if before is None or before.index is None else before.index[rows]
    if now is None:
        return np.sort(stored)
    index = np.arange(now.rows) if now.index is None else now.index
    if not np.isin(stored, index).all():
        raise DatasetError(
            "Some of these rows belong to episodes that were replaced since the mode was split: "
            "split it again."
        )
    places = np.argsort(index)
    return np.sort(places[np.searchsorted(index, stored, sorter=places)])
