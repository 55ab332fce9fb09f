"""Unrolling: a network learns from several steps of its own predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from physx_core.components.network import Network
from physx_core.components.predicted_batch import PredictedBatch
from physx_core.components.transformation import Transformation
from physx_core.config import EnvironmentConfig
from physx_core.errors import ConfigError, listed
from physx_core.fields import Field, free_axes
from physx_core.packing import packed_fields
from physx_core.pipelines.learning.batches.stored import StoredBatches
from physx_core.pipelines.learning.learner import Learner
from physx_core.pipelines.learning.meshes import renumber, split_rows
from physx_core.results.rivals import NotRunError, same_quantity
from physx_core.typing import Array, Batch, Tensors
from physx_core.views.batches import Batches
from physx_core.views.sources import window_of
from physx_core.views.view import View

_NOISE = 0x6E6F697365
"""Distinguishes the random numbers of noise from others of the same seed."""


class _Fed(NamedTuple):
    """A prediction that becomes an input, and how many rows after its window a target is."""

    target: str
    prediction: str
    later: int


class Unrolling:
    """Predicts batches of windows in several steps, each from the predictions of the one before.

    All steps together are one batch, so that any loss is that of all of them. What is predicted and
    is the same quantity as an input takes its place in the next step, by `Field.like`; all other
    inputs, and the targets, are those of the data.

    Attributes:
        longest: Number of steps that windows are read for.
        stride: Number of rows between two steps.
    """

    def __init__(
        self, schedule: Sequence[int], noise: float, network: Network, batches: Batches, seed: int
    ) -> None:
        """Find out what is fed back.

        Args:
            schedule: Number of steps in each epoch; the last one holds for all further epochs.
            noise: See `Training.noise`.
            network: The network.
            batches: Batches of single steps, of all fields that are needed.
            seed: Seed of the noise.

        Raises:
            ConfigError: If nothing is, or windows lack what the next step needs.
        """
        self._schedule, self._noise, self._seed = tuple(schedule) or (1,), noise, seed
        if any(type(steps) is not int or steps < 1 for steps in self._schedule):
            raise ConfigError(
                f"Training.unroll is {list(schedule)!r} but must be numbers of steps, at least 1."
            )
        if not 0 <= noise < float("inf"):
            raise ConfigError(f"Training.noise is {noise!r} but must not be negative.")
        if batches.view.edges != "inside":
            raise ConfigError('Training.unroll needs View.edges="inside", where all is known.')
        self.longest = max(self._schedule)
        self._network = network
        added = packed_fields(free_axes(batches.fields.values()))
        self._fields = {name: of for name, of in batches.fields.items() if name not in added}
        self._read: Mapping[str, Field] = self._fields
        self._at = {name: batches.window(name).at for name in self._fields}
        self._singles = {name for name in self._at if batches.window(name).is_single}
        self._meshes = {name for name, of in self._fields.items() if of.free_axis or of.indexes}
        if self._meshes - self._singles:
            raise ConfigError(
                "Training.unroll needs windows of one row where axes are free, but "
                f"{listed(sorted(self._meshes - self._singles))} have several."
            )
        self._fed = self._find_fed(network, batches)
        self.stride = self._find_stride()
        for name in self._fed:
            self._check_known(name)
        self._epoch, self._batch = 0, 0

    def _find_fed(self, network: Network, batches: Batches) -> dict[str, _Fed]:
        found: dict[str, _Fed] = {}
        reasons = []
        for target, prediction in zip(network.opt_fields, network.pred_fields, strict=False):
            try:
                name, _ = same_quantity(target, network.net_fields, batches)
            except NotRunError as error:
                reasons.append(f"{target}: {error}")
                continue
            # What another field holds of the same row is what the next row begins with.
            is_own = batches.window(name).field == batches.window(target).field
            found[name] = _Fed(target, prediction, 0 if is_own else 1)
            if batches.fields[target].numpy_dtype.kind not in "fc":
                raise ConfigError(
                    f'Training.unroll cannot feed back "{target}", which consists of classes.'
                )
        if not found:
            raise ConfigError(
                "Training.unroll and noise need a prediction that becomes an input in the next "
                f"step, but there is none: {'; '.join(reasons)}. Windows of one field are the same "
                'quantity: View(window={"past": ("state", 0), "next": ("state", 1)}).'
            )
        return found

    def _find_stride(self) -> int:
        strides = {
            name: max(self._at[fed.target]) + fed.later - max(self._at[name])
            for name, fed in self._fed.items()
        }
        if len(set(strides.values())) > 1 or min(strides.values()) < 1:
            raise ConfigError(
                "Training.unroll needs predictions of the same later time, but they are "
                f"{', '.join(f'{n} rows later ({name})' for name, n in strides.items())}."
            )
        return next(iter(strides.values()))

    def _check_known(self, name: str) -> None:
        """Check that each value of an input is known when it is needed."""
        fed, known = self._fed[name], set(self._at[name])
        for step in range(1, self.longest):
            before = (step - 1) * self.stride
            known |= {at + fed.later + before for at in self._at[fed.target]}
            needed = {at + step * self.stride for at in self._at[name]}
            if needed - known:
                raise ConfigError(
                    f'Training.unroll cannot fill the window "{name}" from predictions of '
                    f'"{fed.target}": in step {step + 1} it needs the rows {sorted(needed)}, of '
                    f"which {sorted(needed - known)} are neither known nor predicted."
                )

    def view(self, view: View) -> View:
        """Return the view of all that the steps need, from that of single steps."""
        window = {}
        for name, at in self._at.items():
            steps = range(self.longest)
            if name in self._fed:  # the second one only to check that rows continue each other
                steps = steps[: 1 + self._fed[name].later]
            window[name] = sorted({offset + step * self.stride for offset in at for step in steps})
        shared = sorted({row for name in self._meshes for row in window[name]})
        self._rows = window | dict.fromkeys(self._meshes, shared)
        fields = {name: window_of(view, name).field for name in self._at}
        return replace(view, window={name: (fields[name], self._rows[name]) for name in fields})

    def reads(self, batches: Batches) -> None:
        """Keep the fields of the batches of the `view`."""
        self._read = batches.fields

    def check(self, stored: StoredBatches, transformation: Transformation) -> None:
        """Check that rows continue each other, and that noise has a scale.

        Args:
            stored: The samples, read as the `view` says.
            transformation: What normalizes, with its coefficients.

        Raises:
            ConfigError: If not.
        """
        batch = stored.read(0, list(self._at))
        rows = split_rows(batch, self._read, self._fields).values
        for name, fed in self._fed.items():
            if fed.later and self.longest > 1:
                self._check_continued(name, fed, rows)
            normalized = transformation.normalization.get(name)
            if self._noise and (normalized is None or normalized.since):
                raise ConfigError(
                    f"Training.noise is in standard deviations, but {name} has none: normalize it "
                    "(DatasetConfig.normalize)."
                )
            if self._noise and batch[name].dtype.kind != "f":
                raise ConfigError(f"Training.noise needs real numbers, which {name} has not.")

    def _check_continued(self, name: str, fed: _Fed, rows: Mapping[str, Sequence[Array]]) -> None:
        last = max(self._at[fed.target])
        now = rows[fed.target][self._rows[fed.target].index(last)]
        then = rows[name][self._rows[name].index(max(self._at[name]) + self.stride)]
        if not np.allclose(now, then, rtol=1e-3, atol=1e-6):
            raise ConfigError(
                f'Training.unroll goes on with the next row, but "{name}" of it is not '
                f'"{fed.target}" of the row before: use windows of one field, for example '
                f'View(window={{"past": ("{name}", 0), "next": ("{name}", 1)}}).'
            )

    def begin(self, epoch: int, batch: int) -> None:
        """Begin an epoch, or go on within it.

        Args:
            epoch: Number of finished epochs.
            batch: Number of finished batches of this one.
        """
        self._epoch, self._batch = epoch, batch

    @property
    def steps(self) -> int:
        """Number of steps in the current epoch."""
        return self._schedule[min(self._epoch, len(self._schedule) - 1)]

    def predict(self, batch: Batch, transformation: Transformation, rank: int) -> PredictedBatch:
        """Predict a batch of the `view`, in physical units, in several steps.

        Args:
            batch: The batch; or this process's share of it.
            transformation: The network's.
            rank: Index of the process.
        """
        network = self._network
        given = self._noisy(batch, transformation, rank) if self._noise else batch
        self._batch += 1
        known, added = self._tensors_of(given)
        fixed = network.numpy_to_tensor(added) if added else {}
        parts: list[PredictedBatch] = []
        for step in range(self.steps):
            if parts:
                self._feed(parts[-1].physical_prediction, known, step)
            inputs = {**self._inputs(known, step), **fixed}
            parts.append(PredictedBatch.of(network, transformation, inputs))
        if added:
            parts = [self._renumbered(part, added, step) for step, part in enumerate(parts)]
        return PredictedBatch.joined(parts)

    def _tensors_of(self, batch: Batch) -> tuple[dict[str, dict[int, Any]], Batch]:
        """Return the rows of each field by their numbers, and what packing adds to each."""
        convert = self._network.numpy_to_tensor
        if not self._meshes:
            data = convert(batch)
            return {
                name: {row: data[name][:, i] for i, row in enumerate(self._rows[name])}
                for name in self._at
            }, {}
        values, added = split_rows(batch, self._read, self._fields)
        return {
            name: {
                row: convert({name: each})[name]
                for row, each in zip(self._rows[name], rows, strict=True)
            }
            for name, rows in values.items()
        }, added

    def _renumbered(self, part: PredictedBatch, added: Batch, step: int) -> PredictedBatch:
        """Return a step as a part of all of them, whose meshes follow one another."""
        if not step:
            return part
        data, inputs = (renumber(of, self._fields, added, step) for of in (part.data, part.inputs))
        return replace(part, data=data, inputs=inputs)

    def _inputs(self, known: Mapping[str, Mapping[int, Any]], step: int) -> Tensors:
        found = {}
        for name, at in self._at.items():
            values = [known[name][offset + step * self.stride] for offset in at]
            if name in self._singles:
                found[name] = values[0]
            else:
                found[name] = self._network.join_tensors([v[:, None] for v in values], axis=1)
        return found

    def _feed(self, prediction: Tensors, known: dict[str, dict[int, Any]], step: int) -> None:
        for name, fed in self._fed.items():
            values, is_single = prediction[fed.prediction], fed.target in self._singles
            for i, offset in enumerate(self._at[fed.target]):
                row = offset + fed.later + (step - 1) * self.stride
                known[name][row] = values if is_single else values[:, i]

    def _noisy(self, batch: Batch, transformation: Transformation, rank: int) -> Batch:
        """Return a batch with noise on the inputs that are fed back, by its number alone."""
        entropy = [self._seed, _NOISE, self._epoch, self._batch, rank]
        rng = np.random.Generator(np.random.Philox(np.random.SeedSequence(entropy)))
        noisy = {}
        for name in self._fed:
            values, normalization = batch[name], transformation.normalization[name]
            noise = self._noise * normalization.std * rng.standard_normal(values.shape)
            changed = values * np.exp(noise) if normalization.log else values + noise
            noisy[name] = changed.astype(values.dtype)
        return {**batch, **noisy}

    def describe(self) -> str:
        """Return in words what is done."""
        fed = listed(f"{each.prediction} as {name}" for name, each in self._fed.items())
        noise = f", with noise of {self._noise:g} standard deviations" if self._noise else ""
        steps = ", ".join(map(str, self._schedule))
        return f"unrolled: {steps} steps by epoch, which feed back {fed}{noise}"


def open_unrolling(
    schedule: Sequence[int],
    noise: float,
    learner: Learner,
    stored: StoredBatches,
    environment: EnvironmentConfig | None,
    seed: int,
) -> Unrolling | None:
    """Have a network learn from several steps, if that is wanted.

    Args:
        schedule: See `Training.unroll`.
        noise: See `Training.noise`.
        learner: The network.
        stored: The samples.
        environment: What generates or replays them, if anything.
        seed: Seed of the training.

    Raises:
        ConfigError: If it is wanted, but is not possible.
    """
    if not (schedule or noise):
        return None
    if environment is not None:
        raise ConfigError(
            "Training.unroll and noise need stored trajectories, but environments generate or "
            "replay single rows: generate the samples first."
        )
    unrolling = Unrolling(schedule, noise, learner.network, stored.training, seed)
    unrolling.reads(stored.read_as(unrolling.view))
    learner.unroll(unrolling.predict)
    return unrolling
