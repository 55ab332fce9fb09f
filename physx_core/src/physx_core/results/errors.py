"""Errors: how far predictions of one field are off, summed over batches, by episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from physx_core.fields import Field
from physx_core.results.wording import Interval
from physx_core.typing import Array, Index

ERRORS = ("rmse", "relative_l2", "max", "accuracy", "balanced_accuracy")
"""Names of errors; of the accuracies, larger values are better."""
FEWEST = 8
"""Number of episodes below which nothing is said about chance."""
_DRAWS = 2000
_GROUPS = 1000
_LEVEL = 0.01
_SAME = 0.01
"""Relative difference of errors below which they are the same for all purposes."""
_NEAR_ZERO = 0.01
_MOST_CLASSES = 64
_MOST_COMPONENTS = 8


@dataclass(frozen=True, eq=False)
class Target:
    """What is predicted, and how its errors are measured.

    Attributes:
        field: The field.
        classes: The classes, ascending; None: it is a real number.
        scale: What errors are divided by where components of several units are added up, so that
            they count alike; shape of a value, or ().
        boundary: Between False and True in predictions of a boolean field.
    """

    field: Field
    classes: Index | None
    scale: Array
    boundary: float = 0.5

    @classmethod
    def of(cls, field: Field, values: Array, loss: str) -> Target:
        """Find out what a field is.

        Args:
            field: The field.
            values: Values to learn from, shape (rows, *field shape).
            loss: Name of the loss: with "Logits" in it, a prediction above 0 means True.
        """
        boundary = 0.0 if "Logits" in loss else 0.5
        if values.dtype.kind in "biu":
            classes = np.unique(values).astype(np.int64)
            if field.numpy_dtype.kind == "b":
                classes = np.arange(2)
            if len(classes) <= _MOST_CLASSES:
                return cls(field, classes, np.ones(()), boundary)
        scale = np.ones(())
        if "," in field.unit and len(values):
            spread = values.std(axis=0, dtype=np.float64)
            scale = np.where(spread > 0, spread, 1.0)
        return cls(field, None, scale)

    def at(self, field: Field) -> Target:
        """Return the same for a field of another shape; units belong to its last axis."""
        if field.shape == self.field.shape:
            return self
        own, wanted = self.scale.shape, field.shape or ()
        scale = np.ones(())
        if own and wanted and own[-1] == wanted[-1]:
            scale = self.scale.reshape(-1, own[-1]).mean(axis=0)
        return replace(self, field=field, scale=scale)

    @property
    def kind(self) -> Literal["real", "classes"]:
        """What its values are."""
        return "real" if self.classes is None else "classes"

    def decode(self, predicted: Array) -> Array | None:
        """Return predicted values, shape (rows, *field shape); None: they are of another shape.

        Of a class, the prediction may have another axis, before the field's own or after them, with
        a number for each class, of which the largest is meant.
        """
        shape, own = predicted.shape[1:], self.field.shape or ()
        if self.classes is None:
            return predicted if shape == own else None
        if shape == own:
            if self.field.numpy_dtype.kind == "b" and predicted.dtype.kind == "f":
                return np.asarray(predicted > self.boundary, np.int64)
            return np.asarray(np.rint(predicted), np.int64)
        if len(shape) == len(own) + 1 and shape[1:] == own:
            return np.asarray(predicted.argmax(axis=1))
        if len(shape) == len(own) + 1 and shape[:-1] == own:
            return np.asarray(predicted.argmax(axis=-1))
        return None


def as_loss(name: str, value: float) -> float:
    """Return an error, or of an accuracy what is missing to 1, and the other way round."""
    return 1.0 - value if name.endswith("accuracy") else value


class Errors:
    """Sums over the predictions of one field; memory depends on the number of episodes only.

    Attributes:
        sums: Sum over the values of each episode of the squared error, or of wrong classes.
        counts: Number of values of each episode.
        truth: Sum of the squared true values of each episode.
    """

    def __init__(self, target: Target, groups: int) -> None:
        """Begin with nothing.

        Args:
            target: What is predicted.
            groups: Number of episodes.
        """
        self._target = target
        self.sums, self.counts, self.truth = (np.zeros(groups) for _ in range(3))
        self._max, self._components = 0.0, np.zeros(target.field.shape or ())
        size = 0 if target.classes is None else len(target.classes)
        self._confusion = np.zeros((size, size), np.int64)

    def add(self, guess: Array, truth: Array, groups: Index, valid: Array | None = None) -> None:
        """Add predictions.

        Args:
            guess: Predictions as `Target.decode` returns them.
            truth: True values, of the same shape.
            groups: The episode of each row, shape (rows,).
            valid: Which values count, of a shape that broadcasts; None: all.
        """
        rows = len(truth)
        counted = np.ones((1,) * truth.ndim) if valid is None else valid
        each = np.broadcast_to(counted, truth.shape).reshape(rows, -1).sum(axis=1, dtype=float)
        np.add.at(self.counts, groups, each)
        if self._target.classes is not None:
            wrong = ((guess != truth) & (counted > 0)).reshape(rows, -1).sum(axis=1, dtype=float)
            np.add.at(self.sums, groups, wrong)
            self._confuse(guess, truth, self._target.classes, counted)
            return
        kind = np.complex128 if truth.dtype.kind == "c" else np.float64
        size = np.abs(np.subtract(guess, truth, dtype=kind)) * counted
        scale = self._target.scale
        self._components += np.square(size).sum(axis=0)
        size = size / scale
        self._max = max(self._max, float(size.max(initial=0.0)))
        error = np.square(size).reshape(rows, -1).sum(axis=1)
        norm = np.square(np.abs(truth) * counted / scale).reshape(rows, -1).sum(axis=1)
        np.add.at(self.sums, groups, error)
        np.add.at(self.truth, groups, norm)

    def _confuse(self, guess: Array, truth: Array, classes: Index, counted: Array) -> None:
        places = [np.minimum(classes.searchsorted(v), len(classes) - 1) for v in (truth, guess)]
        known = (classes[places[0]] == truth) & (classes[places[1]] == guess) & (counted > 0)
        pairs = (places[0] * len(classes) + places[1])[known]
        found = np.bincount(pairs.ravel(), minlength=len(classes) ** 2)
        self._confusion += found.reshape(self._confusion.shape)

    @property
    def groups(self) -> Index:
        """The episodes that have values."""
        return np.flatnonzero(self.counts)

    @property
    def by_episode(self) -> Array:
        """The error of each of `groups`: root mean square, or share of wrong values."""
        some = self.groups
        means = self.sums[some] / self.counts[some]
        return np.asarray(means if self._target.classes is not None else np.sqrt(means))

    def errors(self) -> tuple[dict[str, float], int]:
        """Return the errors by name, and how many episodes have no relative one."""
        some, total = self.groups, float(self.counts.sum())
        mean = float(self.sums.sum()) / total
        if self._target.classes is not None:
            known = self._confusion.sum(axis=1)
            recall = self._confusion.diagonal()[known > 0] / known[known > 0]
            balanced = float(recall.mean()) if len(recall) else float("nan")
            return {"accuracy": 1.0 - mean, "balanced_accuracy": balanced}, 0
        truth, count = self.truth[some], self.counts[some]
        large = truth / count > _NEAR_ZERO**2 * truth.sum() / total
        relative = np.sqrt(self.sums[some][large] / truth[large])
        found = {"rmse": float(np.sqrt(mean))}
        if len(relative):
            found["relative_l2"] = float(relative.mean())
        return {**found, "max": self._max}, int(len(some) - large.sum())

    def interval(self) -> Interval | None:
        """Return the 95 % interval of ``rmse`` or ``accuracy``; None: too few episodes."""
        some = self.groups
        if len(some) < FEWEST:
            return None
        sums, counts = drawn_sums(self.sums[some], self.counts[some])
        means = np.quantile(sums / counts, (0.025, 0.975))
        if self._target.classes is not None:
            return float(1 - means[1]), float(1 - means[0])
        low, high = np.sqrt(means).tolist()
        return low, high

    @property
    def confusion(self) -> tuple[tuple[int, ...], ...]:
        """Number of values by true class, then by predicted class; empty of real numbers."""
        return tuple(map(tuple, self._confusion.tolist()))

    def by_component(self) -> tuple[tuple[float, str], ...]:
        """Return root mean square errors and units of the components, if there are few of them."""
        size, field = self._components.size, self._target.field
        units = [unit.strip() for unit in field.unit.split(",")]
        if self._target.classes is not None or not 1 < size <= _MOST_COMPONENTS:
            return ()
        if len(units) == 1 or len(units) != size:
            units = [field.unit if len(units) == 1 else ""] * size
        each = np.sqrt(self._components.ravel() * size / self.counts.sum())
        return tuple(zip(each.tolist(), units, strict=True))


def _gathered(*columns: Array) -> tuple[Array, ...]:
    """Return columns of values by episode; of many episodes, those of a thousand random groups."""
    count = len(columns[0])
    if count <= _GROUPS:
        return columns
    of = np.random.default_rng(1).permutation(count) % _GROUPS
    return tuple(np.bincount(of, column, _GROUPS) for column in columns)


def drawn_sums(*columns: Array) -> Sequence[Array]:
    """Return the sums of columns over episodes that are drawn at random, with replacement.

    Args:
        columns: Values of each episode, shape (episodes,) each.

    Returns:
        The sums in each of 2000 draws, shape (2000,) each.
    """
    gathered = _gathered(*columns)
    count = len(gathered[0])
    chosen = np.random.default_rng(0).integers(0, count, (_DRAWS, count))
    return [column[chosen].sum(axis=1) for column in gathered]


def is_chance(differences: Array) -> bool:
    """Return whether differences of pairs may be of random sign, with a probability above 1 %.

    Unlike a bootstrap, which is wrong in 7 % of the cases for 8 episodes instead of in 1 %, this is
    exact for few episodes.

    Args:
        differences: Difference in each episode, shape (episodes,).
    """
    (found,) = _gathered(differences)
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (_DRAWS, len(found)))
    sums = np.abs(signs @ found)
    return bool((sums >= abs(found.sum()) * (1 - 1e-12)).mean() > _LEVEL)


def compare(network: Errors, rival: Errors, unit: str) -> dict[str, Any]:
    """Compare two predictions of the same samples; see `RivalResult`.

    Args:
        network: Errors of the network.
        rival: Errors of the rival.
        unit: What the episodes are, for the reason why nothing can be said.

    Returns:
        ``verdict``, ``ratio``, ``interval`` and ``why``.
    """
    some, power = network.groups, 1.0 if network.confusion else 0.5
    own, other = network.sums[some], rival.sums[some]
    ratio = float((own.sum() / other.sum()) ** power) if other.sum() else float("nan")
    if len(some) < FEWEST:
        why = _too_few(len(some), unit)
        return {"verdict": "unknown", "ratio": ratio, "interval": None, "why": why}
    sums, others = drawn_sums(own, other)
    tails = _LEVEL / 2, 1 - _LEVEL / 2
    low, high = np.quantile(sums - others, tails)
    interval = None
    if (others > 0).all():
        least, most = np.quantile((sums / others) ** power, tails).tolist()
        interval = least, most
    verdict = "wins" if high < 0 else "loses" if low > 0 else "even"
    if abs(ratio - 1) < _SAME or is_chance(own - other):
        verdict = "even"
    return {"verdict": verdict, "ratio": ratio, "interval": interval, "why": ""}


def _too_few(count: int, unit: str) -> str:
    return f"too few {unit} to say: {count}, fewer than {FEWEST}"


def mean_interval(values: Sequence[float]) -> Interval | None:
    """Return the 95 % interval of the mean of a number over episodes; None: too few episodes."""
    if len(values) < FEWEST:
        return None
    [sums] = drawn_sums(np.asarray(values, np.float64))
    low, high = (np.quantile(sums, (0.025, 0.975)) / len(values)).tolist()
    return low, high


def compare_rewards(policy: Sequence[float], rival: Sequence[float]) -> dict[str, Any]:
    """Compare the rewards of two policies in the same episodes; see `ActionsResult`.

    Returns:
        ``verdict``, ``difference``, ``interval`` and ``why``.
    """
    differences = np.asarray(policy, np.float64) - np.asarray(rival, np.float64)
    mean, count = float(differences.mean()), len(differences)
    if count < FEWEST:
        why = _too_few(count, "episodes")
        return {"verdict": "unknown", "difference": mean, "interval": None, "why": why}
    [sums] = drawn_sums(differences)
    low, high = (np.quantile(sums, (_LEVEL / 2, 1 - _LEVEL / 2)) / count).tolist()
    verdict = "wins" if low > 0 else "loses" if high < 0 else "even"
    if not mean or is_chance(differences):
        verdict = "even"
    return {"verdict": verdict, "difference": mean, "interval": (low, high), "why": ""}
