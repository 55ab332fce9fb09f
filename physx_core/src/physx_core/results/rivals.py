"""Rivals: predictions that need no network; a network that does not beat them learned nothing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.results.errors import Target
from physx_core.results.sample import TrainingSample
from physx_core.typing import Array, Batch, Index
from physx_core.views.batches import Batches

Check = Callable[[float], None]
"""Raises `TooSlowError` if there is less time left than so many s."""

Predict = Callable[[Batch], "Batch | Array"]
"""A user's rival: it gets the network's inputs by name, in physical units, shape (rows, ...) each,
and returns predictions by the name of the true field, or those of the only one."""

_FEWEST_ROWS = 32
_WIDEST = 1500
"""Largest number of unknowns of the linear map; of more inputs, it is found from as many rows."""
_OUTPUTS = 64
"""Largest number of outputs that choose the penalty."""
_SECONDS_PER_FLOP = 6e-11
_PENALTIES = 10.0 ** np.arange(-9, 4, 2)
_PROJECTED = 128
_NEIGHBORS = 10_000


class NotRunError(Exception):
    """A rival cannot be computed, or means nothing; the text says why."""


class TooSlowError(NotRunError):
    """There is no time left for a rival."""


class Rival(ABC):
    """Predicts all fields that it can; what is common to them is computed once."""

    def __init__(self, sample: TrainingSample, targets: Mapping[str, Target], check: Check) -> None:
        """Learn from samples.

        Args:
            sample: The samples.
            targets: What is predicted, by name.
            check: See `Check`.

        Raises:
            NotRunError: If it cannot be computed.
        """
        self._sample, self._targets, self._check = sample, targets, check

    def prepare(self, batch: Batch) -> Any:
        """Return what is common to the predictions of all fields of a batch."""
        return None

    @abstractmethod
    def predict(self, name: str, batch: Batch, common: Any) -> Array:
        """Return the prediction of a field, shape (rows, *field shape)."""


class Mean(Rival):
    """The mean of the samples; of classes, the most frequent one."""

    def __init__(self, sample: TrainingSample, targets: Mapping[str, Target], check: Check) -> None:
        super().__init__(sample, targets, check)
        self._values = {}
        for name, target in targets.items():
            values = sample.batch[name]
            if target.classes is None:
                kind = np.complex128 if values.dtype.kind == "c" else np.float64
                self._values[name] = values.mean(axis=0, dtype=kind)
            else:
                counts = [(values == label).sum(axis=0) for label in target.classes]
                self._values[name] = target.classes[np.argmax(counts, axis=0)]

    def predict(self, name: str, batch: Batch, common: Any) -> Array:
        """Return the mean, or the most frequent class."""
        return np.broadcast_to(self._values[name], batch[name].shape)


class Linear(Rival):
    """A linear map by ridge regression, whose penalty a fifth of the trajectories chooses.

    Of more inputs than samples, the map is found in its dual form, from the products of samples.
    Classes are those with the largest of the values that the map predicts for each of them.
    """

    def __init__(self, sample: TrainingSample, targets: Mapping[str, Target], check: Check) -> None:
        super().__init__(sample, targets, check)
        x, (fit, back) = sample.inputs, sample.split()
        if len(x) < _FEWEST_ROWS:
            raise NotRunError(f"{len(x)} samples in memory are too few")
        if x.shape[1] > _WIDEST < len(x):
            some = np.linspace(0, len(x) - 1, _WIDEST).astype(int)
            fit, back = np.intersect1d(fit, some), np.intersect1d(back, some)
        x = x[np.concatenate([fit, back])]
        y = {name: _numbers(target, sample.batch[name][np.concatenate([fit, back])])
             for name, target in targets.items()}  # fmt: skip
        size, width = min(x.shape), sum(each.shape[1] for each in y.values())
        each = 2 / 3 * size**3
        flops = (2 * x.size * size + (len(_PENALTIES) + 1) * each) * len(y) + 2 * size**2 * width
        check(_SECONDS_PER_FLOP * flops)
        self._known = x if x.shape[1] > len(x) else None
        self._maps = {name: self._fit(x, values, len(fit)) for name, values in y.items()}

    def _fit(self, x: Array, y: Array, fit: int) -> tuple[Array, Array]:
        """Return the weights of what `prepare` returns, and the mean.

        Args:
            x: Inputs, shape (rows, columns).
            y: Outputs, shape (rows, outputs).
            fit: Number of rows to learn from, before those that choose the penalty.
        """
        mean = y[:fit].mean(axis=0)
        few = np.unique(np.linspace(0, y.shape[1] - 1, _OUTPUTS).astype(int))
        wanted = (y - mean)[:, few]
        if self._known is None:
            gram, right, left = x[:fit].T @ x[:fit], x[:fit].T @ wanted[:fit], x[fit:]
        else:
            gram = x @ x.T
            left, right = gram[fit:, :fit], wanted[:fit]
            whole, gram = gram, gram[:fit, :fit]
        errors = [
            float(np.square(left @ _solve(gram, right, p * fit) - wanted[fit:]).sum())
            for p in _PENALTIES
        ]
        penalty, mean = _PENALTIES[int(np.argmin(errors))] * len(x), y.mean(axis=0)
        if self._known is not None:
            return _solve(whole, y - mean, penalty), mean
        whole = gram + x[fit:].T @ x[fit:]
        return _solve(whole, x.T @ (y - mean), penalty), mean

    def prepare(self, batch: Batch) -> Array:
        """Return the inputs, or in dual form their products with those of the samples."""
        inputs = self._sample.read(batch)
        return inputs if self._known is None else inputs @ self._known.T

    def predict(self, name: str, batch: Batch, common: Any) -> Array:
        """Return what the map predicts."""
        weights, mean = self._maps[name]
        return _from_numbers(self._targets[name], common @ weights + mean, batch[name].shape)


def _solve(gram: Array, right: Array, penalty: float) -> Array:
    found: Array = np.linalg.solve(gram + penalty * np.eye(len(gram)), right)
    return found


class Nearest(Rival):
    """The value of the sample with the nearest inputs."""

    def __init__(self, sample: TrainingSample, targets: Mapping[str, Target], check: Check) -> None:
        super().__init__(sample, targets, check)
        width = sample.inputs.shape[1]
        rng = np.random.default_rng(0)
        self._bins = None
        if width > _PROJECTED:  # sums of inputs with random signs keep distances, on average
            order = rng.permutation(width)
            begins = np.linspace(0, width, _PROJECTED, endpoint=False).astype(int)
            self._bins = order, rng.choice((-1.0, 1.0), width), begins
        known = self._project(sample.inputs)[:_NEIGHBORS]
        norms = np.square(known).sum(axis=1, keepdims=True)
        self._known = np.hstack([-2 * known, norms]).T.copy()

    def _project(self, inputs: Array) -> Array:
        if self._bins is not None:
            order, signs, begins = self._bins
            inputs = np.add.reduceat(inputs[:, order] * signs, begins, axis=1)
        return inputs.astype(np.float32)

    def prepare(self, batch: Batch) -> Array:
        """Return which sample is nearest to each row."""
        inputs, found = self._project(self._sample.read(batch)), []
        inputs = np.hstack([inputs, np.ones((len(inputs), 1), np.float32)])
        for first in range(0, len(inputs), 64):
            self._check(0)
            found.append((inputs[first : first + 64] @ self._known).argmin(axis=1))
        return np.concatenate(found)

    def predict(self, name: str, batch: Batch, common: Any) -> Array:
        """Return the values of the nearest samples."""
        found: Array = self._sample.batch[name][common]
        return found


class Unchanged(Rival):
    """What a field is, if nothing changes: the last value of the same quantity in the inputs."""

    def __init__(self, sources: Mapping[str, tuple[str, int | None]]) -> None:
        """Keep which input is the same quantity as each predicted field: see `same_quantity`."""
        self._sources = sources

    def predict(self, name: str, batch: Batch, common: Any) -> Array:
        """Return the last value."""
        given, place = self._sources[name]
        values = batch[given] if place is None else batch[given][:, place]
        extra = batch[name].ndim - values.ndim
        return np.broadcast_to(values[(slice(None), *(None,) * extra)], batch[name].shape)


class Own(Rival):
    """What a user's function of the network's inputs predicts."""

    def __init__(self, function: Predict, given: Sequence[str]) -> None:
        """Keep the function, and the names of its inputs."""
        self._function, self._given = function, given

    def prepare(self, batch: Batch) -> Any:
        """Return what the function returns."""
        try:
            return self._function({name: batch[name] for name in self._given})
        except Exception as error:  # the network is stored: a run must not fail for its result
            raise NotRunError(f"it failed: {error!r}") from error

    def predict(self, name: str, batch: Batch, common: Any) -> Array:
        """Return the field's part of it."""
        if isinstance(common, Mapping) and name not in common:
            raise NotRunError("it does not predict this field")
        found: Array = np.asarray(common[name] if isinstance(common, Mapping) else common)
        if found.shape != batch[name].shape:
            raise NotRunError(
                f"it returned the shape {found.shape} where the field has {batch[name].shape}"
            )
        return found


def same_quantity(name: str, given: Sequence[str], batches: Batches) -> tuple[str, int | None]:
    """Return the input that is the same quantity as a predicted field, and where its last value is.

    Args:
        name: Name of the predicted field.
        given: Names of the inputs.
        batches: Batches of all of them.

    Returns:
        The name of the input, and the place of its last value in its window; None: it is no window.

    Raises:
        NotRunError: If no input is known to be the same quantity, or it has another shape.
    """
    own, wanted = batches.window(name), batches.fields[name].shape or ()
    for other in sorted(given, key=lambda each: -max(batches.window(each).at)):
        window, shape = batches.window(other), batches.fields[other].shape or ()
        same = batches.quantity(other) == batches.quantity(name) and other != name
        last = shape if window.is_single else shape[1:]
        if same and last == (wanted if own.is_single else wanted[1:]):
            return other, None if window.is_single else int(np.argmax(window.at))
    raise NotRunError(
        f"no input of the network is known to be the same quantity; if one is, say so: "
        f'Field("{name}", like=...)'
    )


def _numbers(target: Target, values: Array) -> Array:
    """Return what a linear map predicts, shape (rows, columns)."""
    if target.classes is not None:
        values = (values[..., None] == target.classes).astype(np.float64)
    flat = values.reshape(len(values), -1)
    parts = [flat.real, flat.imag] if flat.dtype.kind == "c" else [flat]
    return np.concatenate(parts, axis=1, dtype=np.float64)


def _from_numbers(target: Target, found: Array, shape: tuple[int, ...]) -> Array:
    if target.classes is not None:
        labels: Index = target.classes[found.reshape(*shape, -1).argmax(axis=-1)]
        return labels
    if target.field.numpy_dtype.kind == "c":
        half = found.shape[1] // 2
        found = found[:, :half] + 1j * found[:, half:]
    return found.reshape(shape)
