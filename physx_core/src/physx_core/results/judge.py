"""Judge: measures a network's errors on samples that it has not learned from, and its rivals'."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field

import numpy as np

from physx_core.errors import ConfigError
from physx_core.fields import PTR
from physx_core.results.errors import Errors, Target, compare
from physx_core.results.metrics import Metric, Metrics
from physx_core.results.result import EpisodeError, FieldResult, PartResult, RivalResult
from physx_core.results.rivals import (
    Linear,
    Mean,
    Nearest,
    NotRunError,
    Own,
    Predict,
    Rival,
    TooSlowError,
    Unchanged,
    same_quantity,
)
from physx_core.results.sample import TrainingSample
from physx_core.typing import Array, Batch, Index
from physx_core.views.batches import PAD, Batches

MEAN, CLASS, LINEAR = "mean", "most frequent class", "linear map"
UNCHANGED, NEAREST = "nothing changes", "nearest neighbor"
DEFAULT = (MEAN, UNCHANGED, LINEAR, NEAREST)
_COMPARED = 5_000
"""Number of samples on which rivals are compared; of more, batches at equal distances are."""
_ALIKE = 0.5
"""Mean squared difference of consecutive rows, as a share of that of any two: suspicious below."""
_NETWORK = "network"
_TRAJECTORY = (
    "no rival is compared: nothing is known of episodes (the fields episode and step), and "
    "consecutive rows are alike, as those of a trajectory are"
)
_NEIGHBORS = (
    "the samples are not known to be of other episodes than those that the network learned from"
)
_NOUNS = {"episode": "episodes", "trajectory": "trajectories", "block": "blocks of rows"}
_LEAST_SECONDS = 2.0
_SHARE = 0.08
"""Of the training's time; what else is measured takes the rest of a tenth."""


@dataclass(frozen=True, eq=False)
class Judged:
    """Samples to judge a network on.

    Attributes:
        batches: Their batches, in the order of writing.
        is_apart: Whether they are of other episodes than those that the network learned from.
        division: Which part of the episodes they are, in words; empty: all of `place`.
        used: What they decided about the network, in words; empty: nothing.
        place: Where they are, in words.
    """

    batches: Batches
    is_apart: bool
    division: str
    used: str = ""
    place: str = 'the mode "validation"'

    @classmethod
    def of(cls, batches: Batches, *, has_mode: bool, used: str = "") -> Judged:
        """Take samples that a training held back.

        Args:
            batches: Their batches.
            has_mode: Whether they are a mode of their own.
            used: What they decided about the network, in words.
        """
        is_apart = "block" not in batches.group_nouns and (has_mode or batches.is_whole)
        return cls(batches, is_apart, "" if has_mode else " and ".join(batches.division), used)


@dataclass(frozen=True, eq=False)
class Predictor:
    """A trained network.

    Attributes:
        predict: Returns the prediction for a batch, both in physical units.
        given: Names of its inputs.
        pairs: Name of each true field, and of its prediction.
        losses: Name of the loss of each true field.
    """

    predict: Callable[[Batch], Batch]
    given: Sequence[str]
    pairs: Mapping[str, str]
    losses: Mapping[str, str] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """The fields that batches must have."""
        return list(dict.fromkeys((*self.given, *self.pairs)))


class Judge:
    """Judges a network, and what predicts without one.

    Attributes:
        rate: Number of samples that the network predicted per s, in batches as large as in
            validation; NaN before the first.
    """

    def __init__(
        self,
        network: Predictor,
        training: Batches,
        metrics: Mapping[str, Metric] | None = None,
        rivals: Mapping[str, Predict | None] | None = None,
    ) -> None:
        """Read some of the samples that the network learns from.

        Args:
            network: The network.
            training: Batches of these samples.
            metrics: Further errors by name.
            rivals: Who else predicts, by name: a user's function, or None for one of `DEFAULT`;
                None: all of these.
        """
        self._network, self._metrics = network, metrics or {}
        self._wanted = dict.fromkeys(DEFAULT) if rivals is None else rivals
        with training.reading(network.names) as self._training:
            self._sample = TrainingSample(self._training, network.given)
        fields, batch = self._training.fields, self._sample.batch
        self._targets = {
            name: Target.of(fields[name].of_entries, batch[name], network.losses.get(name, ""))
            for name in network.pairs
        }
        self._rivals: dict[str, Rival] = {}
        self._why: dict[tuple[str, str], str] = {}
        self._predicted, self._predicting = 0, 0.0

    @property
    def targets(self) -> Mapping[str, Target]:
        """How errors are measured, by predicted field."""
        return self._targets

    @property
    def rate(self) -> float:
        """Number of samples per s."""
        return self._predicted / self._predicting if self._predicting else float("nan")

    def _check(self, seconds: float) -> None:
        if self._clock() + seconds > self._deadline:
            raise TooSlowError(f"it takes longer than the {self._seconds:.3g} s that rivals have")

    def learn(self, seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Let the rivals learn that can be computed, and keep why others cannot.

        Args:
            seconds: Duration of the training in s: the rivals get 8 % of it, and at least 2 s.
            clock: Returns the time in s.
        """
        self._seconds, self._clock = max(_LEAST_SECONDS, seconds * _SHARE), clock
        self._deadline = clock() + self._seconds
        self._rivals = {
            name: Own(function, self._network.given)
            for name, function in self._wanted.items() if function is not None
        }  # fmt: skip
        sources: dict[str, tuple[str, int | None]] = {}
        for name in self._targets if UNCHANGED in self._wanted else ():
            try:
                sources[name] = same_quantity(name, self._network.given, self._training)
            except NotRunError as error:
                self._why[UNCHANGED, name] = str(error)
        makers: dict[str, Callable[[], Rival]] = {
            MEAN: lambda: Mean(self._sample, self._targets, self._check),
            LINEAR: lambda: Linear(self._sample, self._targets, self._check),
            NEAREST: lambda: Nearest(self._sample, self._targets, self._check),
        }
        if sources:
            self._rivals[UNCHANGED] = Unchanged(sources)
        for rival in (name for name in makers if name in self._wanted):
            try:
                self._check(0)
                if self._sample.is_packed and rival != MEAN:
                    raise NotRunError("samples have different sizes")
                self._rivals[rival] = makers[rival]()
            except NotRunError as error:
                self._drop(rival, error)

    def _drop(self, rival: str, error: NotRunError) -> None:
        self._why |= {(rival, name): str(error) for name in self._targets}

    def measure(self, batches: Batches) -> dict[str, float]:
        """Return the network's errors, as ``error/FIELD/NAME`` and ``metric/NAME``."""
        sums = {name: Errors(of, batches.num_groups) for name, of in self._targets.items()}
        missing: dict[str, str] = {}
        with batches.reading(self._network.names) as reading:
            metrics = self._begin_metrics(reading)
            for number in range(len(reading)):
                batch, where = reading[number], reading.groups(number)
                guesses = self._predict(batch, len(where), missing)
                self._add(sums, guesses, batch, where)
                if metrics is not None:
                    metrics.add(guesses, batch, where)
        found = {
            f"error/{name}/{key}": value
            for name, of in sums.items() if name not in missing
            for key, value in of.errors()[0].items()
        }  # fmt: skip
        means = {} if metrics is None else metrics.means
        return found | {f"metric/{name}": value for name, value in means.items()}

    def _begin_metrics(self, batches: Batches) -> Metrics | None:
        if not self._metrics:
            return None
        if self._sample.is_packed:
            raise ConfigError("Metrics of fields with free axes are not supported: leave them out.")
        counts = np.zeros(batches.num_groups, np.intp)
        for number in range(len(batches)):
            np.add.at(counts, batches.groups(number), 1)
        return Metrics(self._metrics, counts)

    def judge(self, part: Judged) -> PartResult:
        """Measure all errors on a part of the data; the rivals must have learned.

        Args:
            part: The samples.
        """
        with part.batches.reading(self._network.names) as batches:
            return self._of_shapes(batches)._judge(part, batches)

    def _of_shapes(self, batches: Batches) -> Judge:
        """Return a judge of samples whose fields may have other shapes: another resolution."""
        shapes = {n: batches.fields[n].shape for n in self._network.names}
        if all(self._training.fields[name].shape == shape for name, shape in shapes.items()):
            return self
        other = copy(self)
        other._targets = {
            name: of.at(batches.fields[name].of_entries) for name, of in self._targets.items()
        }
        why = "it learned from samples of another shape"
        gone = (MEAN, LINEAR, NEAREST)
        other._rivals = {n: r for n, r in self._rivals.items() if n not in gone}
        other._why = {**self._why, **{(n, f): why for n in gone for f in self._targets}}
        return other

    def _judge(self, part: Judged, batches: Batches) -> PartResult:
        groups, every = batches.num_groups, max(1, -(-batches.num_items // _COMPARED))
        whole = {name: Errors(target, groups) for name, target in self._targets.items()}
        sums = {
            who: {name: Errors(target, groups) for name, target in self._targets.items()}
            for who in (_NETWORK, *self._rivals)
        }
        missing: dict[str, str] = {}
        metrics = self._begin_metrics(batches)
        seen, compared, steps, spread = np.zeros(groups, bool), 0, 0.0, 0.0
        for number in range(len(batches)):
            batch, where = batches[number], batches.groups(number)
            seen[where] = True
            if "block" in batches.group_nouns and not self._is_reshaped(batches):
                inputs = self._sample.read(batch)
                steps += float(np.square(np.diff(inputs, axis=0)).sum())
                spread += 2.0 * (inputs.size - inputs.shape[1])
            guesses = self._predict(batch, len(where), missing)
            self._add(whole, guesses, batch, where)
            if metrics is not None:
                metrics.add(guesses, batch, where)
            if number % every == 0:
                compared += len(where)
                self._add(sums[_NETWORK], guesses, batch, where)
                self._add_rivals(sums, part, batch, where)
        why = ""
        if "block" in batches.group_nouns:
            alike = steps < _ALIKE * spread or self._is_reshaped(batches)
            why = _TRAJECTORY if alike else "nothing is known of episodes: blocks of rows count"
        fields = {
            name: self._field(name, part, whole[name], sums, is_said=why != _TRAJECTORY)
            for name in self._targets
            if name not in missing
        }
        count = int(seen.sum())
        division = part.division or f"{count} {self._nouns(batches)} of {part.place}"
        return PartResult(
            *(batches.num_items, count, division, part.used, fields, compared, why, missing),
            {} if metrics is None else metrics.means,
        )

    def _is_reshaped(self, batches: Batches) -> bool:
        names = self._network.given
        return self._sample.is_packed or any(
            batches.fields[n].shape != self._training.fields[n].shape for n in names
        )

    def _nouns(self, batches: Batches) -> str:
        return " or ".join(dict.fromkeys(_NOUNS[noun] for noun in batches.group_nouns))

    def _predict(self, batch: Batch, rows: int, missing: dict[str, str]) -> Batch:
        """Return the network's predictions by true field; keep why there are none of some."""
        begin = time.monotonic()
        answer, found = self._network.predict(batch), {}
        self._predicting += time.monotonic() - begin
        self._predicted += rows
        for name, predicted in self._network.pairs.items():
            guess = self._targets[name].decode(answer[predicted])
            if guess is not None:
                found[name] = guess
            else:
                own, other = answer[predicted].shape[1:], batch[name].shape[1:]
                missing[name] = f"the prediction has the shape {own}, the field {other}"
        return found

    def _add_rivals(
        self, sums: dict[str, dict[str, Errors]], part: Judged, batch: Batch, groups: Index
    ) -> None:
        for name, rival in list(self._rivals.items()):
            if name == NEAREST and not part.is_apart:
                continue
            try:
                common = rival.prepare(batch)
            except NotRunError as error:
                self._drop(name, error)
                del self._rivals[name]
                continue
            guesses = {}
            for each in self._targets:
                try:
                    if (name, each) not in self._why:
                        guesses[each] = rival.predict(each, batch, common)
                except NotRunError as error:
                    self._why[name, each] = str(error)
            self._add(sums[name], guesses, batch, groups)

    def _add(self, sums: Mapping[str, Errors], guesses: Batch, batch: Batch, groups: Index) -> None:
        for name, guess in guesses.items():
            if axis := self._training.fields[name].free_axis:
                sums[name].add(
                    guess, batch[name], np.repeat(groups, np.diff(batch[axis + PTR])), None
                )
                continue
            truth, padded = batch[name], batch.get(f"{name}{PAD}")
            valid: Array | None = None
            if padded is not None:
                valid = ~padded[(..., *(None,) * (truth.ndim - padded.ndim))]
            sums[name].add(guess, truth, groups, valid)

    def _field(
        self, name: str, part: Judged, own: Errors, sums: Mapping[str, Mapping[str, Errors]],
        *, is_said: bool,
    ) -> FieldResult:  # fmt: skip
        target, batches = self._targets[name], part.batches
        errors, near_zero = own.errors()
        by_episode, groups = own.by_episode, own.groups
        order = np.argsort(by_episode, kind="stable")
        places = {"best": order[0], "median": order[len(order) // 2], "worst": order[-1]}
        episodes = {
            label: EpisodeError(float(by_episode[k]), batches.describe_group(int(groups[k])))
            for label, k in places.items()
        } if len(order) > 2 else {}  # fmt: skip
        rivals = {}
        for rival in self._wanted:
            why = self._why.get((rival, name), "")
            if rival == NEAREST and not part.is_apart:
                why = _NEIGHBORS
            label = CLASS if rival == MEAN and target.classes is not None else rival
            if why:
                rivals[label] = RivalResult(why=why)
                continue
            found = compare(sums[_NETWORK][name], sums[rival][name], self._nouns(batches))
            if not is_said:
                found |= {"verdict": "unknown", "interval": None, "why": "not compared: see below"}
            rivals[label] = RivalResult(sums[rival][name].errors()[0], **found)
        return FieldResult(
            target.kind,
            target.field.unit,
            errors,
            own.interval() if is_said else None,
            own.by_component(),
            own.confusion,
            () if target.classes is None else tuple(target.classes.tolist()),
            near_zero,
            episodes,
            rivals,
        )
