"""TrainingRecord and BestEpoch: a training's running statistics and its best epoch."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from physx_core.results.errors import as_loss

RECENT = 50
"""Window of the running mean and variance, in batches or epochs."""


class TrainingRecord:
    """Sums over the current epoch, and the losses of the last batches and epochs.

    Batches are kept until `take_batches` accounts for all of them at once: a mean and a variance
    for each would take longer than the step of a small network.
    """

    def __init__(self, state: Mapping[str, Any]) -> None:
        """Start, or continue from a `state`; an empty state starts."""
        self._count: int = state.get("count", 0)
        self._sums: dict[str, float] = dict(state.get("sums", {}))
        self._recent = deque[float](state.get("recent", ()), RECENT)
        self._epochs = deque[float](state.get("epochs", ()), RECENT)
        self._batches: list[tuple[int, dict[str, float]]] = []

    @property
    def state(self) -> dict[str, Any]:
        """The state that a resumed training needs, as plain data, once all batches are taken."""
        return {
            "count": self._count,
            "sums": dict(self._sums),
            "recent": list(self._recent),
            "epochs": list(self._epochs),
        }

    def add(self, number: int, losses: Mapping[str, float]) -> None:
        """Add a batch.

        Args:
            number: Number of the batch, counted over all epochs.
            losses: The batch's statistics, ``loss`` among them.
        """
        self._batches.append((number, {name: float(value) for name, value in losses.items()}))

    def take_batches(self) -> list[tuple[int, dict[str, float]]]:
        """Return number and values of each batch added since the last call, to record them.

        The values are ``<name>/batch`` for each entry, and the loss's mean and sample variance over
        the last `RECENT` batches, ``loss/mean`` and ``loss/variance``.
        """
        batches, self._batches = self._batches, []
        spreads = _spreads(self._recent, [losses["loss"] for _, losses in batches])
        sums, taken = self._sums, []
        for (number, losses), (mean, variance) in zip(batches, spreads, strict=True):
            for name, value in losses.items():
                sums[name] = sums.get(name, 0.0) + value
            values = {f"{name}/batch": value for name, value in losses.items()}
            taken.append((number, {**values, "loss/mean": mean, "loss/variance": variance}))
        self._count += len(batches)
        return taken

    def take_epoch(self) -> dict[str, float]:
        """Return the values to record for the epoch, once all batches are taken; start a new one.

        These are ``<name>/training``, the mean of each entry over the batches, and the loss's mean
        and sample variance over the last `RECENT` epochs, ``loss/training_mean`` and
        ``loss/training_variance``. Empty if there was no batch.
        """
        if not self._count:
            return {}
        values = {f"{name}/training": total / self._count for name, total in self._sums.items()}
        self._count, self._sums = 0, {}
        ((mean, variance),) = _spreads(self._epochs, [values["loss/training"]])
        return {**values, "loss/training_mean": mean, "loss/training_variance": variance}


def _spreads(recent: deque[float], added: Sequence[float]) -> list[list[float]]:
    """Append values to the recent ones; return mean and sample variance after each of them.

    The variance of a single value is 0. How many are added at once changes no bit.
    """
    count, values = len(recent), np.array([*[0.0] * RECENT, *recent, *added])
    recent.extend(added)
    rows = len(added)
    sizes = np.arange(count + 1, count + rows + 1).clip(max=RECENT)[:, np.newaxis]
    windows = sliding_window_view(values, RECENT)[len(values) - RECENT + 1 - rows :].copy()
    with np.errstate(invalid="ignore", over="ignore"):  # of a training that goes on after NaN
        means = windows.sum(axis=1, keepdims=True) / sizes
        deviations = np.where(np.arange(RECENT) < RECENT - sizes, 0.0, windows - means)
        variances = np.square(deviations).sum(axis=1, keepdims=True) / (sizes - 1).clip(min=1)
    spreads: list[list[float]] = np.hstack([means, variances]).tolist()
    return spreads


class BestEpoch:
    """The epoch with the smallest loss, and the number of epochs without improvement.

    Attributes:
        loss: The smallest loss so far.
        epoch: Number of epochs finished at that time.
        waited: Number of epochs judged since the loss last improved by `min_improvement`.
    """

    def __init__(self, state: Mapping[str, Any], min_improvement: float) -> None:
        """Start, or continue from a `state`.

        Args:
            state: See `state`; an empty one starts.
            min_improvement: Smallest decrease of the loss that counts as an improvement.
        """
        self.loss: float = state.get("loss", math.inf)
        self.epoch: int = state.get("epoch", 0)
        self.waited: int = state.get("waited", 0)
        self._reference: float = state.get("reference", math.inf)
        self._min_improvement = min_improvement

    @property
    def state(self) -> dict[str, Any]:
        """The state that a resumed training needs, as plain data."""
        return {
            "loss": self.loss,
            "epoch": self.epoch,
            "waited": self.waited,
            "reference": self._reference,
        }

    def update(self, loss: float, epoch: int) -> bool:
        """Record an epoch's loss and return whether it is the smallest so far.

        Args:
            loss: Validation loss, or training loss. NaN is not an improvement.
            epoch: Number of finished epochs.
        """
        if loss < self._reference - self._min_improvement:
            self._reference, self.waited = loss, 0
        else:
            self.waited += 1
        if not loss < self.loss:
            return False
        self.loss, self.epoch = loss, epoch
        return True

    def describe(self, name: str) -> str:
        """Return the best value in words.

        Args:
            name: What decides.
        """
        value = as_loss(name, self.loss)
        least = "largest" if name.endswith("accuracy") else "smallest"
        return f"{least} {name} {value:.6g}, after epoch {self.epoch}"

    def reason_to_stop(self, patience: int, name: str) -> str:
        """Return why to stop after `patience` epochs without improvement; empty: continue."""
        if self.waited < patience:
            return ""
        return (
            f"The training stopped early: the {name} did not improve {self.waited} times "
            f"in a row (patience={patience}); {self.describe(name)}."
        )
