"""RowStatistics: mean, deviation, and quantiles of the rows that environments generate."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from physx_core.observers import FIELDS
from physx_core.statistics import RunningStatistics
from physx_core.typing import Array, Batch, Index

Doubles = NDArray[np.float64]

_SMALL = 9
"""Largest number of components that have separate statistics."""
_DRAWN = 32
"""Number of components drawn from each row of a larger field."""
_KEPT = 1024
"""Number of rows that quantiles are computed from."""
_CHUNK = 256
_STREAM = 3
_QUANTILES = {"q05": 0.05, "median": 0.5, "q95": 0.95}


class RowStatistics:
    """Summarizes rows in constant memory.

    A field of up to 9 components has statistics of each component. A larger field has common
    statistics of 32 components of each row, drawn at random. Mean and deviation are over all rows,
    quantiles over 1024 rows drawn at random without replacement. The results depend only on the
    seed and the rows.
    """

    def __init__(self, seed: int, total: int) -> None:
        """Start without rows.

        Args:
            seed: Seed of the run.
            total: Total number of rows to expect.
        """
        self._seed, self._total = seed, total
        self._random = np.random.default_rng([seed, _STREAM])
        self._columns: dict[str, _Columns] = {}
        self._priorities: Doubles = np.zeros(0)  # of the kept rows, which have the smallest ones
        self._count = self._waiting = self._due = 0

    def add(self, rows: Batch, names: Iterable[str]) -> dict[str, float]:
        """Add rows, and return the statistics if they are due, otherwise an empty dictionary.

        They are due when the number of rows has grown by a tenth, and after the last row.

        Args:
            rows: Field name to array of shape (rows, *field shape), finite; at least one row.
            names: The floating-point fields, the same in each call.

        Returns:
            ``fields/<field>/<component>/<figure>`` to value, in the field's unit; without the
            component if the field has one, or more than 9. The figures are ``mean``, ``std``,
            ``q05`` (the 5 % quantile), ``median``, and ``q95``.
        """
        if not self._columns:
            self._columns = {
                name: _Columns(rows[name].shape[1:], [self._seed, _STREAM, number])
                for number, name in enumerate(names)
            }
        count = 0
        for name, columns in self._columns.items():
            count = columns.add(rows[name])
        self._count += count
        self._waiting += count
        is_due = self._count >= self._due or self._count == self._total
        if is_due or self._waiting >= _CHUNK:
            self._take_waiting()
        if not is_due:
            return {}
        self._due = self._count + max(1, self._count // 10)
        return {
            "/".join((FIELDS, name, *figure)): value
            for name, columns in self._columns.items()
            for figure, value in columns.figures()
        }

    def _take_waiting(self) -> None:
        """Include the waiting rows, and keep the rows with the smallest random numbers."""
        known = np.concatenate([self._priorities, self._random.random(self._waiting)])
        kept: Index = np.arange(len(known))
        if len(known) > _KEPT:
            kept = np.argpartition(known, _KEPT)[:_KEPT]
        self._priorities, self._waiting = known[kept], 0
        for columns in self._columns.values():
            columns.take_waiting(kept)


class _Columns:
    """A field's statistics: of each component, or of all in one column if there are many."""

    def __init__(self, shape: tuple[int, ...], seed: Sequence[int]) -> None:
        self._size = math.prod(shape)
        self._labels: Sequence[tuple[str, ...]] = [()]
        if 1 < self._size <= _SMALL:
            self._labels = [("_".join(map(str, place)),) for place in np.ndindex(shape)]
        self._random = np.random.default_rng(seed)
        self._running = RunningStatistics()
        self._waiting: list[Doubles] = []
        self._kept: Doubles = np.zeros((0, min(self._size, _DRAWN)))

    def add(self, values: Array) -> int:
        """Copy the values of some rows, and return the number of rows."""
        rows = values.reshape(len(values), self._size)
        if self._size > _DRAWN:
            places = self._random.random((len(rows), _DRAWN)) * self._size
            rows = np.take_along_axis(rows, places.astype(np.intp), 1)
        self._waiting.append(rows.astype(np.float64))
        return len(rows)

    def take_waiting(self, kept: Index) -> None:
        """Include the waiting rows.

        Args:
            kept: The rows to keep, as positions among those kept before and the waiting rows.
        """
        rows = np.concatenate(self._waiting)
        self._waiting.clear()
        self._running.update(rows.reshape(-1, len(self._labels)))
        self._kept = np.concatenate([self._kept, rows])[kept]

    def figures(self) -> Iterator[tuple[tuple[str, ...], float]]:
        """Yield each figure's label and name, and its value."""
        if not self._kept.size:
            return
        sample = self._kept.reshape(-1, len(self._labels))
        quantiles = np.quantile(sample, list(_QUANTILES.values()), axis=0)
        figures = {"mean": self._running.mean, "std": self._running.std}
        figures |= dict(zip(_QUANTILES, quantiles, strict=True))
        for column, label in enumerate(self._labels):
            for name, values in figures.items():
                yield (*label, name), float(values[column])
