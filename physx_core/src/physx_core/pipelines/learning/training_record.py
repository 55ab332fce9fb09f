"""TrainingRecord and BestEpoch: a training's running statistics and its best epoch."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping
from typing import Any

RECENT = 50
"""Window of the running mean and variance, in batches or epochs."""


class TrainingRecord:
    """Sums over the current epoch, and the losses of the last batches and epochs."""

    def __init__(self, state: Mapping[str, Any]) -> None:
        """Start, or continue from a `state`; an empty state starts."""
        self._count: int = state.get("count", 0)
        self._sums: dict[str, float] = dict(state.get("sums", {}))
        self._recent = deque[float](state.get("recent", ()), RECENT)
        self._epochs = deque[float](state.get("epochs", ()), RECENT)

    @property
    def state(self) -> dict[str, Any]:
        """The state that a resumed training needs, as plain data."""
        return {
            "count": self._count,
            "sums": dict(self._sums),
            "recent": list(self._recent),
            "epochs": list(self._epochs),
        }

    def add(self, losses: Mapping[str, float]) -> dict[str, float]:
        """Add a batch and return the values to record.

        These are ``<name>/batch`` for each entry, and the loss's mean and sample variance over the
        last `RECENT` batches, ``loss/mean`` and ``loss/variance``.

        Args:
            losses: The batch's statistics, ``loss`` among them.
        """
        values, sums = {}, self._sums
        for name, value in losses.items():
            values[f"{name}/batch"] = number = float(value)
            sums[name] = sums.get(name, 0.0) + number
        self._count += 1
        self._recent.append(values["loss/batch"])
        values["loss/mean"], values["loss/variance"] = _spread(self._recent)
        return values

    def take_epoch(self) -> dict[str, float]:
        """Return the values to record for the epoch, and start a new one.

        These are ``<name>/training``, the mean of each entry over the batches, and the loss's mean
        and sample variance over the last `RECENT` epochs, ``loss/training_mean`` and
        ``loss/training_variance``. Empty if there was no batch.
        """
        if not self._count:
            return {}
        values = {f"{name}/training": total / self._count for name, total in self._sums.items()}
        self._count, self._sums = 0, {}
        self._epochs.append(values["loss/training"])
        values["loss/training_mean"], values["loss/training_variance"] = _spread(self._epochs)
        return values


def _spread(recent: Collection[float]) -> tuple[float, float]:
    """Return the mean and the sample variance; the variance of a single value is 0."""
    size = len(recent)
    mean = sum(recent) / size
    squares = sum([(value - mean) * (value - mean) for value in recent])
    return mean, squares / (size - 1) if size > 1 else 0.0


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

    def judge(self, loss: float, epoch: int) -> bool:
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

    def reason_to_stop(self, patience: int) -> str:
        """Return why to stop after `patience` epochs without improvement; empty: continue."""
        if self.waited < patience:
            return ""
        return (
            f"The training stopped early: the loss did not improve {self.waited} times in a row "
            f"(patience={patience}). The smallest was {self.loss:.6g}, after epoch {self.epoch}."
        )
