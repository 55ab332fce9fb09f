"""Metrics: a user's functions of predictions and true values, averaged over episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from physx_core.errors import ConfigError
from physx_core.typing import Batch, Index

Metric = Callable[[Batch, Batch], float]
"""Returns a number for the predictions and the true values of an episode, in physical units."""


class Metrics:
    """Calls metrics with whole episodes; keeps rows until those of their episode are complete."""

    def __init__(self, metrics: Mapping[str, Metric], counts: Index) -> None:
        """Begin with nothing.

        Args:
            metrics: The metrics by name.
            counts: Number of rows of each episode.
        """
        self._metrics, self._left = metrics, counts.copy()
        self._kept: dict[int, list[tuple[Batch, Batch]]] = {}
        self._sums, self._count = dict.fromkeys(metrics, 0.0), 0

    def add(self, predicted: Batch, truth: Batch, groups: Index) -> None:
        """Add rows.

        Args:
            predicted: Predictions by the name of the true field, shape (rows, *field shape).
            truth: Inputs and true values.
            groups: The episode of each row, shape (rows,).
        """
        order = np.argsort(groups, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(groups[order])) + 1):
            group = int(groups[rows[0]])
            part = tuple({n: v[rows] for n, v in each.items()} for each in (predicted, truth))
            self._kept.setdefault(group, []).append((part[0], part[1]))
            self._left[group] -= len(rows)
            if not self._left[group]:
                self._finish(self._kept.pop(group))

    def _finish(self, parts: list[tuple[Batch, Batch]]) -> None:
        predicted, truth = (
            {name: np.concatenate([part[name] for part in each]) for name in each[0]}
            for each in zip(*parts, strict=True)
        )
        self._count += 1
        for name, metric in self._metrics.items():
            value = metric(predicted, truth)
            if not (np.ndim(value) == 0 and np.isreal(value)):
                raise ConfigError(
                    f"The metric {name} must return a number for each episode, not {value!r}."
                )
            self._sums[name] += float(value)

    @property
    def means(self) -> dict[str, float]:
        """The mean of each metric over the episodes."""
        return {name: total / max(1, self._count) for name, total in self._sums.items()}
