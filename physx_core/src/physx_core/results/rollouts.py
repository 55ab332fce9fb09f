"""Rollouts: predictions fed back as inputs, from the beginning of episodes to their end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from physx_core.errors import ConfigError
from physx_core.fields import PTR
from physx_core.results.errors import Target
from physx_core.results.judge import Predictor
from physx_core.results.result import Drift, EpisodeError, RolloutResult
from physx_core.results.rivals import NotRunError, same_quantity
from physx_core.typing import Array, Batch, Index
from physx_core.views.batches import Batches

Invariant = Callable[[Batch], Array]
"""Returns a number for each row of fields and parameters, arrays of shape (rows, ...)."""

_MOST_EPISODES = 100
_MOST_PREDICTIONS = 1000


@dataclass(frozen=True)
class Loop:
    """How predictions are fed back.

    Attributes:
        feeds: Predicted fields, each with the inputs that are the same quantity.
        offsets: Rows after the reference row at which each of them is predicted.
        stride: Number of rows from a prediction to the next.
        follows: Predicted fields that are stored in a row with the value before them.
    """

    feeds: Mapping[str, Sequence[str]]
    offsets: Mapping[str, Sequence[int]]
    stride: int
    follows: Sequence[str]


@dataclass(frozen=True, eq=False)
class Trace:
    """Predictions of an episode that were fed back.

    Attributes:
        rows: Rows of the mode in which the true values are, ascending.
        truth: The true values by field, arrays of shape (rows, ...).
        prediction: The predicted ones.
    """

    rows: Sequence[int]
    truth: Batch
    prediction: Batch


def find_loop(network: Predictor, batches: Batches) -> Loop:
    """Find out how predictions are fed back.

    Args:
        network: The network.
        batches: Batches of its inputs and of the true values.

    Raises:
        NotRunError: If nothing that is predicted continues an input.
    """
    feeds: dict[str, list[str]] = {}
    offsets: dict[str, tuple[int, ...]] = {}
    follows, why = [], ""
    for name in network.pairs:
        try:
            same_quantity(name, network.given, batches)
        except NotRunError as error:
            why = f"{name}: {error}"
            continue
        quantity, own = batches.quantity(name), batches.window(name)
        feeds[name] = [each for each in network.given if batches.quantity(each) == quantity]
        offsets[name] = own.at
        if own.field not in {batches.window(each).field for each in feeds[name]}:
            if not own.is_single or any(batches.window(e).at != own.at for e in feeds[name]):
                raise NotRunError(f"{name} and {feeds[name]} have windows at different offsets")
            follows.append(name)
            offsets[name] = (1,)
    if not feeds:
        raise NotRunError(why or "nothing that it predicts has true values")
    last = min(max(at) for at in offsets.values())
    for stride in range(last, 0, -1):
        if all(
            offset + stride in offsets[name] or offset + stride in batches.window(each).at
            for name, inputs in feeds.items()
            for each in inputs
            for offset in batches.window(each).at
        ):
            return Loop(feeds, offsets, stride, follows)
    told = ", ".join(f"{name} at {list(at)}" for name, at in offsets.items())
    raise NotRunError(f"what is predicted ({told}) leaves gaps between its inputs")


def roll_out(
    network: Predictor,
    batches: Batches,
    targets: Mapping[str, Target],
    *,
    part: str = "other",
    steps: int | None = None,
    invariants: Mapping[str, Invariant] | None = None,
) -> dict[str, RolloutResult]:
    """Feed predictions back, and compare them with the truth at each row of episodes.

    Inputs that are not predicted are the true ones of each row.

    Args:
        network: The network.
        batches: Batches of a single source, in the order of writing.
        targets: How errors are measured, by predicted field.
        part: What these samples are called.
        steps: Largest number of rows to predict; None: to the end of the episodes.
        invariants: Numbers by name that the physics keeps.

    Returns:
        What was found, by predicted field.

    Raises:
        NotRunError: If there is nothing to feed back, or no two items of an episode.
        ConfigError: If an invariant does not return one number for each row.
    """
    runs = _Runs.open(network, batches, targets, invariants or {})
    return runs.run(part, _MOST_PREDICTIONS * runs.stride if steps is None else steps)


def trace(
    network: Predictor,
    batches: Batches,
    targets: Mapping[str, Target],
    about: Mapping[str, Any],
    steps: int | None = None,
) -> Trace:
    """Feed predictions back in one of the episodes of `roll_out`, and keep them.

    Args:
        network: The network.
        batches: Batches of a single source, in the order of writing.
        targets: How errors are measured, by predicted field.
        about: The episode: see `EpisodeError`.
        steps: Largest number of rows to predict; None: to the end of the episode.

    Raises:
        NotRunError: If there is nothing to feed back, or no such episode.
    """
    runs = _Runs.open(network, batches, targets, {})
    return runs.trace(
        about["first_row"], _MOST_PREDICTIONS * runs.stride if steps is None else steps
    )


class _Runs:
    """The rollouts of all episodes, side by side."""

    @classmethod
    def open(
        cls,
        network: Predictor,
        batches: Batches,
        targets: Mapping[str, Target],
        invariants: Mapping[str, Invariant],
    ) -> Self:
        """Find out what is fed back in which episodes."""
        if len(batches.datasets) > 1:
            raise NotRunError("the samples are of several sources; evaluate on one of them")
        loop = find_loop(network, batches)
        reading = batches.reading(network.names)
        meshes = [each for each in network.names if reading.fields[each].free_axis]
        if not all(reading.window(each).is_single for each in meshes):
            raise NotRunError("windows of several rows have meshes of several rows")
        if meshes and invariants:
            raise NotRunError("invariants need rows of one size")
        known = {
            name: targets[name] if name in meshes else targets[name].at(reading.fields[name])
            for name in loop.feeds
        }
        for name, target in known.items():
            if target.classes is not None:
                raise NotRunError(f"{name} has classes, not real numbers")
        return cls(network, reading, loop, known, dict(invariants))

    def __init__(
        self,
        network: Predictor,
        batches: Batches,
        loop: Loop,
        targets: Mapping[str, Target],
        invariants: dict[str, Invariant],
    ) -> None:
        self._network, self._batches, self._loop = network, batches, loop
        self._targets, self._invariants = targets, invariants
        self._episodes, self._starts, self._item_at = self._find_episodes()
        self._about = [batches.describe_group(int(group)) for group in self._episodes]
        self._kept: dict[int, Sequence[Batch]] | None = None

    @property
    def stride(self) -> int:
        """Number of rows from a prediction to the next."""
        return self._loop.stride

    def trace(self, first_row: int, steps: int) -> Trace:
        """Predict the episode that begins at a row of the mode."""
        place = next((k for k, a in enumerate(self._about) if a["first_row"] == first_row), None)
        if place is None:
            raise NotRunError(f"no episode begins at row {first_row}")
        one = slice(place, place + 1)
        self._episodes, self._item_at = self._episodes[one], self._item_at[one]
        self._about, self._kept = self._about[one], {}
        self.run("", steps)
        start = self._starts[place] - int(bool(self._loop.follows))
        truth, prediction = (
            {name: np.concatenate([self._rows(name, row[k][name]) for row in self._kept.values()])
             for name in self._loop.feeds}
            for k in (0, 1)
        )  # fmt: skip
        return Trace([start + row for row in self._kept], truth, prediction)

    def _find_episodes(self) -> tuple[Index, list[int], list[dict[int, int]]]:
        """Return episodes, their first reference rows, and their items by the distance to it."""
        count = len(self._batches)
        groups = np.concatenate([self._batches.groups(number) for number in range(count)])
        rows = np.concatenate([self._batches.rows(number)[0] for number in range(count)])
        known, sizes = np.unique(groups, return_counts=True)
        known = known[sizes > 1]
        if not len(known):
            raise NotRunError("no episode has two rows")
        most = np.unique(np.linspace(0, len(known) - 1, _MOST_EPISODES).astype(int))
        chosen, starts, found = known[most], [], []
        for group in chosen:
            items = np.flatnonzero(groups == group)
            starts.append(int(rows[items[0]]))
            places = (rows[items] - starts[-1]).tolist()
            found.append(dict(zip(places, items.tolist(), strict=True)))
        return chosen, starts, found

    def _read(self, row: int, alive: Index) -> tuple[Index, Batch]:
        """Return which episodes have an item at a row, and their values."""
        kept = np.array([k for k in alive if row in self._item_at[k]], int)
        if not len(kept):
            return kept, {}
        return kept, self._batches.take(np.array([self._item_at[k][row] for k in kept]))

    def run(self, part: str, steps: int) -> dict[str, RolloutResult]:
        """Predict up to a number of rows."""
        loop, names = self._loop, list(self._loop.feeds)
        alive, batch = self._read(0, np.arange(len(self._episodes)))
        known = self._known(batch)
        start = {name: known[name][max(o for o in known[name] if o <= 0)] for name in names}
        self._first = {label: self._invariant(label, start, alive) for label in self._invariants}
        records = {name: _Record(len(self._episodes), list(self._invariants)) for name in names}
        row = 0
        while len(alive) and row < steps:
            answer = self._network.predict(batch)
            later = self._record(records, batch, answer, start, alive, row, steps)
            known = {
                name: {o - loop.stride: v for o, v in {**known[name], **later[name]}.items()}
                for name in names
            }
            row += loop.stride
            kept, follow = self._read(row, alive)
            self._check_follows(batch, follow, alive, kept)
            some = {name: self._entries(name, np.isin(alive, kept), batch) for name in names}
            known = {
                name: {offset: values[some[name]] for offset, values in each.items() if offset <= 0}
                for name, each in known.items()
            }
            start = {name: values[some[name]] for name, values in start.items()}
            alive, batch = kept, follow
            if len(alive):
                batch = dict(batch) | self._inputs(known)
        return {
            name: record.result(self._targets[name].field.unit, part, self._about)
            for name, record in records.items()
        }

    def _entries(self, name: str, of_rows: Array, batch: Batch) -> Array:
        """Return what the rows of a batch have; of a free axis, for each entry."""
        axis = self._batches.fields[name].free_axis
        return np.repeat(of_rows, np.diff(batch[axis + PTR])) if axis else of_rows

    def _rows(self, name: str, values: Array) -> Array:
        """Return values of a single episode at a single row, with an axis for the row."""
        return values[np.newaxis] if self._batches.fields[name].free_axis else values

    def _known(self, batch: Batch) -> dict[str, dict[int, Array]]:
        """Return the values of each quantity at offsets from the reference row."""
        found: dict[str, dict[int, Array]] = {}
        for name, inputs in self._loop.feeds.items():
            found[name] = {}
            for each in inputs:
                window = self._batches.window(each)
                for place, offset in enumerate(window.at):
                    values = batch[each] if window.is_single else batch[each][:, place]
                    found[name][offset] = values
        return found

    def _inputs(self, known: Mapping[str, Mapping[int, Array]]) -> Batch:
        """Return the inputs that are fed back."""
        found = {}
        for name, inputs in self._loop.feeds.items():
            for each in inputs:
                window = self._batches.window(each)
                parts = [known[name][offset] for offset in window.at]
                found[each] = parts[0] if window.is_single else np.stack(parts, axis=1)
        return found

    def _values(self, name: str, values: Array) -> dict[int, Array]:
        """Return a predicted field at offsets from the reference row."""
        offsets = self._loop.offsets[name]
        is_single = self._batches.window(name).is_single
        return {
            offset: values if is_single else values[:, place]
            for place, offset in enumerate(offsets)
            if 0 < offset <= self._loop.stride
        }

    def _record(
        self, records: Mapping[str, _Record], batch: Batch, answer: Batch, start: Batch,
        alive: Index, row: int, steps: int,
    ) -> dict[str, dict[int, Array]]:  # fmt: skip
        """Compare predictions with the truth; return them by field and offset."""
        later: dict[str, dict[int, Array]] = {}
        for name in self._loop.feeds:
            guess = self._targets[name].decode(answer[self._network.pairs[name]])
            if guess is None:
                own, other = answer[self._network.pairs[name]].shape[1:], batch[name].shape[1:]
                raise NotRunError(f"the prediction has the shape {own}, the field {name} {other}")
            later[name] = self._values(name, guess)
            true = self._values(name, batch[name])
            scale = self._targets[name].scale
            if scale.ndim and not self._batches.window(name).is_single:
                scale = scale[0] if scale.ndim == batch[name].ndim - 1 else scale
            for offset, values in later[name].items():
                if row + offset <= steps:
                    places = self._entries(name, np.arange(len(alive)), batch)
                    errors = (
                        _mean_square(each, true[offset], scale, places)
                        for each in (values, start[name])
                    )
                    records[name].add(row + offset, alive, *errors)
        common = set.intersection(*(set(each) for each in later.values()))
        rows = [offset for offset in sorted(common) if row + offset <= steps]
        truth = {name: self._values(name, batch[name]) for name in later}
        self._keep(row, rows, truth, later)
        for label in self._invariants:
            first = self._first[label][alive]
            for offset in rows:
                moved = [
                    float(np.abs(self._invariant(label, at, alive) - first).mean())
                    for at in ({n: v[offset] for n, v in each.items()} for each in (later, truth))
                ]
                for record in records.values():
                    record.drift(label, row + offset, *moved)
        return later

    def _keep(
        self, row: int, offsets: Sequence[int], *values: Mapping[str, Mapping[int, Array]]
    ) -> None:
        """Keep values at offsets from a row, if they are traced."""
        if self._kept is not None:
            for offset in offsets:
                self._kept[row + offset] = [
                    {name: each[offset] for name, each in of.items()} for of in values
                ]

    def _invariant(self, label: str, values: Mapping[str, Array], alive: Index) -> Array:
        """Return what a function makes of values and the episodes' parameters, shape (rows,)."""
        parameters = [self._about[k].get("parameters", {}) for k in alive]
        names = parameters[0] if parameters else {}
        given = {name: np.array([each[name] for each in parameters]) for name in names}
        given |= {self._batches.quantity(name): each for name, each in values.items()}
        found = np.asarray(self._invariants[label](given), np.float64)
        if found.shape != (len(alive),):
            raise ConfigError(
                f"The invariant {label} returned the shape {found.shape} for {len(alive)} rows; it "
                f"must return one number for each: ({len(alive)},)."
            )
        return found

    def _check_follows(self, before: Batch, after: Batch, alive: Index, kept: Index) -> None:
        """Check that a row goes on with the mesh and values that the one before it ended with."""
        some = np.isin(alive, kept)
        for name in self._loop.feeds if len(kept) else ():
            axis = self._batches.fields[name].free_axis
            own, new = (np.diff(each[axis + PTR]) if axis else some for each in (before, after))
            if axis and not np.array_equal(own[some], new):
                raise NotRunError(f'the size of the axis "{axis}" changes within an episode')
        for name in self._loop.follows:
            for each in self._loop.feeds[name] if len(kept) else ():
                ended = before[name][self._entries(name, some, before)]
                if not np.allclose(ended, after[each], rtol=1e-4, atol=1e-6):
                    raise NotRunError(
                        f"the rows of an episode do not go on where the one before ended: {each} "
                        f"is not the last {name}"
                    )


class _Record:
    """Errors of a field by row and episode."""

    def __init__(self, episodes: int, labels: Sequence[str]) -> None:
        self._episodes = episodes
        self._squares: dict[int, tuple[Array, Array]] = {}
        self._drifts: dict[str, dict[int, tuple[float, float]]] = {name: {} for name in labels}

    def add(self, row: int, alive: Index, own: Array, unchanged: Array) -> None:
        """Add the mean squared errors of some episodes at a row."""
        found = np.full((2, self._episodes), np.nan)
        found[:, alive] = own, unchanged
        self._squares[row] = found[0], found[1]

    def drift(self, label: str, row: int, own: float, truth: float) -> None:
        """Add by how much an invariant has changed on average."""
        self._drifts[label][row] = own, truth

    def result(self, unit: str, part: str, about: Sequence[Mapping[str, object]]) -> RolloutResult:
        """Return what was found, as far as half of the episodes reach."""
        rows = [
            row for row, (own, _) in self._squares.items()
            if 2 * np.count_nonzero(~np.isnan(own)) >= self._episodes
        ]  # fmt: skip
        own, unchanged = (np.array([self._squares[row][k] for row in rows]) for k in (0, 1))
        errors = np.sqrt(np.nanmean(own, axis=1))
        rivals = np.sqrt(np.nanmean(unchanged, axis=1))
        low, high = np.sqrt(np.nanquantile(own, (0.1, 0.9), axis=1))
        each = np.sqrt(np.nanmean(own, axis=0))
        order = np.argsort(each, kind="stable")
        places = {"best": order[0], "median": order[len(order) // 2], "worst": order[-1]}
        return RolloutResult(
            unit,
            part,
            self._episodes,
            tuple(rows),
            tuple(errors.tolist()),
            tuple(low.tolist()),
            tuple(high.tolist()),
            tuple(rivals.tolist()),
            _first(rows, errors >= 2 * errors[0]),
            _first(rows, errors >= rivals),
            {n: EpisodeError(float(each[k]), about[k]) for n, k in places.items()}
            if len(order) > 2 else {},
            {
                name: Drift(
                    tuple(drift[row][0] for row in rows if row in drift),
                    tuple(drift[row][1] for row in rows if row in drift),
                )
                for name, drift in self._drifts.items()
            },
        )  # fmt: skip


def _first(rows: Sequence[int], wanted: Array) -> int | None:
    """Return the first row after which something is so, except right at the beginning."""
    return rows[int(np.argmax(wanted))] if wanted.any() else None


def _mean_square(guess: Array, truth: Array, scale: Array, places: Index) -> Array:
    """Return the mean squared error of each row, of which there are entries at these places."""
    error = np.abs(np.subtract(guess, truth, dtype=np.result_type(truth, np.float64))) / scale
    means = np.square(error).reshape(len(truth), -1).mean(axis=1)
    return np.bincount(places, means) / np.bincount(places)
