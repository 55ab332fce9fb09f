"""Learner: a network with its transformation and, for training, its optimization."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import checkpoint
from physx_core.components.group import Group
from physx_core.components.network import Network
from physx_core.components.optimization import Optimization
from physx_core.components.predicted_batch import PredictedBatch, pick, predict
from physx_core.components.transformation import Transformation
from physx_core.config import NetworkConfig
from physx_core.errors import (
    ConfigError,
    DivergedError,
    FieldShapeError,
    FieldsMismatchError,
    FieldTypeError,
    MissingFieldError,
    PhysxError,
    UsageError,
    listed,
)
from physx_core.fields import NUMBERS, PTR, Field, free_axes, is_finite
from physx_core.normalization import Normalization
from physx_core.packing import join, pack, packed_fields, split
from physx_core.plugins import create, create_network, import_component
from physx_core.rows import concatenate
from physx_core.typing import Array, Batch, Index, Tensors


class Learner:
    """The components that a `NetworkConfig` describes, working together.

    Attributes:
        config: The configuration, with the transformation's default filled in.
        network: The network.
        transformation: Converts between physical units and what the network computes with.
        optimization: Improves the network; None if nothing is trained.
        fields: The fields that the network was bound to, by name.
        group: The processes that train the network together.
        row_losses: Loss of each row of the last batch, shape (rows,), if requested from `optimize`.
    """

    def __init__(
        self,
        config: NetworkConfig,
        *,
        trains: bool,
        stops_at_nan: bool = True,
        network: Network | None = None,
    ) -> None:
        """Create the components.

        Args:
            config: The components and their arguments.
            trains: Whether to create an optimization too.
            stops_at_nan: Whether `optimize` raises an error if a loss or gradient is not finite.
            network: The network, if it already exists.

        Raises:
            ConfigError: If no network is configured, or a component rejects its arguments.
            PhysxError: If a reference cannot be resolved.
        """
        if config.network is None:
            raise ConfigError(
                'NetworkConfig.network is missing: name a network, for example "torch/fc".'
            )
        self.network: Network = network or create_network(config)
        reference = config.transformation or self.network.default_transformation
        self.transformation: Transformation = create(
            "transformation", reference, config.transformation_kwargs
        )
        self.config = dataclasses.replace(config, transformation=reference)
        self.network.set_data_type(config.data_type)
        self.network.set_device(config.device)
        self.optimization: Optimization | None = None
        self.fields: dict[str, Field] = {}
        self._free: dict[str, Field] = {}  # those of batches, if one of them has a free axis
        self.group = Group()
        self.row_losses: Array = np.zeros(0)
        self._is_between_steps = False
        self._is_checked = False
        self._predict_training = self._predict_batch
        self._read = self.network.numpy_to_tensor
        if trains:
            self.optimization = self._create_optimization(config)
            self.optimization.stops_at_nan = stops_at_nan
            if self.optimization.differentiates_inputs:
                self._read = self._read_with_gradients

    def _create_optimization(self, config: NetworkConfig) -> Optimization:
        reference = config.optimization or self.network.default_optimization
        if not reference:
            raise ConfigError(
                f"{type(self.network).__name__} names no default_optimization: choose what trains "
                "it in NetworkConfig.optimization."
            )
        optimization: Optimization = create("optimization", reference, config.optimization_kwargs)
        arguments = dict(config.optimizer_kwargs)
        if config.lr is not None:
            arguments["lr"] = config.lr
        if config.loss is not None or config.require_training_stuff:
            optimization.set_loss(config.loss)
        if config.optimizer is not None or config.require_training_stuff:
            optimization.set_optimizer(config.optimizer, self.network, **arguments)
        if config.scheduler is not None:
            optimization.scheduler_interval = config.scheduler_interval
            optimization.set_scheduler(config.scheduler, **config.scheduler_kwargs)
        elif config.scheduler_kwargs or config.scheduler_interval:
            option = "kwargs" if config.scheduler_kwargs else "interval"
            raise ConfigError(f"NetworkConfig.scheduler_{option} is given without a scheduler.")
        return optimization

    def bind(self, fields: Mapping[str, Field], normalization: Mapping[str, Normalization]) -> None:
        """Pass the fields' shapes and normalization to the components.

        Raises:
            FieldsMismatchError: If the network needs fields with other names or shapes.
            ConfigError: If it reads free axes, and several processes train it.
        """
        fields = {**fields, **packed_fields(free_axes(fields.values()))}
        self.fields = fields
        self.network.bind(fields)
        self._free = {n: fields[n] for n in self.batch_fields if n in fields}
        why = "text: choose others, or give it another role when it is defined"
        texts = {name: why for name, of in self._free.items() if of.is_text}
        if texts:
            raise FieldsMismatchError(f"{type(self.network).__name__} computes with numbers", texts)
        if not any(field.free_axis for field in self._free.values()):
            self._free = {}
        if self._free and self.group.size > 1:
            raise ConfigError("Networks that read free axes are trained by one process.")
        self.normalize(normalization)

    def normalize(self, normalization: Mapping[str, Normalization]) -> None:
        """Pass the normalization of the network's fields to the transformation.

        Raises:
            ConfigError: If a target is the increment of what the network does not read.
        """
        used = {*self.network.net_fields, *self.network.opt_fields}
        mine = {name: item for name, item in normalization.items() if name in used}
        self.transformation.set_normalization(mine, self.network)
        if any(item.since for item in mine.values()) and not self.transformation.increments:
            raise ConfigError(
                f"{type(self.transformation).__name__}.set_normalization() must call that of its "
                "base class, where targets are increments."
            )

    @property
    def batch_fields(self) -> list[str]:
        """Names of the fields that a training batch must contain."""
        extra = self.optimization.extra_fields if self.optimization is not None else ()
        names = (*self.network.net_fields, *self.network.opt_fields, *extra)
        return list(dict.fromkeys(names))

    def _predict_batch(self, batch: Batch) -> PredictedBatch:
        """Predict a batch in physical units that contains `batch_fields`."""
        if self._free:
            batch, _ = self._pack(batch)
        return PredictedBatch.of(self.network, self.transformation, self._read(batch))

    def _pack(self, batch: Batch) -> tuple[Batch, dict[str, Index]]:
        """Return a batch in which free axes are packed, and the sizes if they were not before."""
        free, sizes = self._free, dict[str, Index]()
        if not free or any(f.free_axis + PTR in batch for f in free.values() if f.free_axis):
            return batch, sizes
        found: Batch = {}
        for name, values in batch.items():
            field = free.get(name)
            if field is None or not field.free_axis:
                found[name] = values
                continue
            rows = [field.convert(each) for each in values]
            found[name], counts = join(field, rows)
            if not np.array_equal(sizes.setdefault(field.free_axis, counts), counts):
                raise FieldShapeError(
                    f'field "{name}" has other sizes of the axis "{field.free_axis}" than the '
                    "fields before it.",
                    field=name,
                )
        fields = {n: free[n] for n in found if n in free}
        return pack(fields, found, sizes, self.network.net_fields), sizes

    def predicted_shape(self, name: str, values: Array) -> tuple[Any, ...]:
        """Return the shape of a predicted field, of which there are values by row."""
        if not values.dtype.hasobject:
            return values.shape[1:]
        pairs = zip(self.network.pred_fields, self.network.opt_fields, strict=False)
        return self.fields[dict(pairs)[name]].free_axis, *values[0].shape[1:]

    def _split(self, answer: Batch, sizes: Mapping[str, Index]) -> Batch:
        """Return predictions row by row if the rows had the sizes of free axes."""
        pairs = zip(self.network.pred_fields, self.network.opt_fields, strict=False)
        axes = {name: self.fields[of].free_axis for name, of in pairs if of in self.fields}
        return {
            name: split(values, sizes[axes[name]]) if axes.get(name) in sizes else values
            for name, values in answer.items()
        }

    def _read_with_gradients(self, batch: Batch) -> Tensors:
        return self.network.with_gradients(self.network.numpy_to_tensor(batch))

    def unroll(self, predict: Callable[[Batch, Transformation, int], PredictedBatch]) -> None:
        """Have `optimize` predict batches otherwise than in one step.

        Args:
            predict: Returns the predictions for a batch, the transformation, and the index of the
                process.

        Raises:
            ConfigError: If the loss differentiates what the network reads.
        """
        if self._trainer().differentiates_inputs:
            raise ConfigError(
                "A loss that differentiates the network's inputs (differentiates_inputs) is one of "
                "single steps: leave out Training.unroll and noise."
            )
        self._predict_training = lambda batch: predict(batch, self.transformation, self.group.rank)

    def _trainer(self) -> Optimization:
        if self.optimization is None:
            raise UsageError("This network was created for prediction and cannot be trained.")
        return self.optimization

    def optimize(
        self, batch: Batch, weight: float | None = None, *, by_row: bool = False
    ) -> dict[str, float]:
        """Train on a batch and return the statistics of the step, ``loss`` first.

        In a group of processes, each trains on its share; the statistics are of the whole batch.

        Args:
            batch: The batch, the same in all processes, or this process's share of it.
            weight: Weight of that share in the mean over the whole batch; None: `batch` is the
                whole batch.
            by_row: Whether to compute `row_losses` as well.

        Raises:
            DivergedError: If the loss or a gradient is not finite, unless
                `Optimization.stops_at_nan` is off.
            UsageError: If there is no optimization, or the prediction lacks a field.
            FieldsMismatchError: If a prediction has not the shape of its target.
        """
        if self._is_between_steps:
            self._is_between_steps = False
            self.network.set_train()
        optimization, group = self.optimization or self._trainer(), self.group
        share = batch
        if weight is None:
            share, weight = (batch, 1.0) if group.size == 1 else group.share_of(batch)
        step = self._predict_training(share)
        if not self._is_checked:
            self._check(step)
        loss, stops = optimization.compute_loss(step), optimization.stops_at_nan
        if stops and isinstance(loss, (float, np.floating)) and not math.isfinite(loss):
            raise DivergedError(self._explain(f"the loss is {loss}", step))
        if by_row:
            self.row_losses = self._compute_row_losses(optimization, step)
        try:  # the mean of the weighted losses of a group is that of the batch
            optimization.optimize(loss if group.size == 1 else loss * (weight * group.size))
        except DivergedError as error:
            raise DivergedError(self._explain(str(error), step)) from None
        losses = _numbers(optimization, loss, step)
        if group.size > 1:
            totals = group.total([value * weight for value in losses.values()])
            losses = dict(zip(losses, totals, strict=True))
        if stops and not math.isfinite(losses["loss"]):
            raise DivergedError(self._explain(f"the loss is {losses['loss']}", step))
        return losses

    def _check(self, step: PredictedBatch) -> None:
        """Check the first prediction: a wrong shape might be broadcast, and trained on."""
        self._is_checked = True
        network, found = self.network, step.prediction
        names = list(network.pred_fields)
        if not isinstance(found, Mapping) or not found.keys() >= set(names):
            given = listed(map(str, found)) if isinstance(found, Mapping) else type(found).__name__
            raise UsageError(
                f"{type(network).__name__}.predict() must return a dictionary with "
                f"{listed(names)}, not {given}."
            )
        differences = {}
        for name, target in zip(names, network.opt_fields, strict=False):
            if self.fields[target].numpy_dtype.kind in "iub":  # labels, of which a loss knows more
                continue
            wanted, values = tuple(step.targets[target].shape), found[name]
            if not hasattr(values, "shape"):
                kind = type(values).__name__
                differences[name] = f'a {kind}, but "{target}" has the shape {wanted}'
            elif tuple(values.shape) != wanted:
                differences[name] = f'shape {tuple(values.shape)}, but "{target}" has {wanted}'
        if differences:
            raise FieldsMismatchError("Prediction and target differ", differences)

    def _compute_row_losses(self, optimization: Optimization, step: PredictedBatch) -> Array:
        found = optimization.compute_row_losses(step)
        losses: Array = self.network.tensor_to_numpy({"loss": found})["loss"].astype(np.float64)
        rows = len(next(iter(step.data.values())))
        if losses.shape != (rows,):
            raise UsageError(
                f"{type(optimization).__name__}.compute_row_losses() returned shape "
                f"{losses.shape} for {rows} rows."
            )
        return losses

    def _explain(self, found: str, step: PredictedBatch) -> str:
        """Return what is not finite, and the first value leading to it that is not finite."""
        for what, tensors in (
            ("the field", step.data),
            ("the network's prediction", step.output),
        ):
            for name, array in self.network.tensor_to_numpy(tensors).items():
                if not is_finite(array):
                    return f'{found}, as {what} "{name}" holds NaN or infinity'
        return f"{found}, though the batch and the network's prediction are finite"

    def mean_losses(self, batches: Iterable[Batch]) -> dict[str, float]:
        """Return the mean statistics over all samples of some batches, ``loss`` first.

        The network is not changed. In a group of processes, each evaluates its share of a batch.
        """
        self.network.set_eval()
        optimization = self._trainer()
        sums: dict[str, float] = {}
        count = 0.0
        for batch in batches:
            share, size = batch, float(len(batch[self._counted(batch)]))
            if self.group.size > 1:
                share, weight = self.group.share_of(batch)
                size *= weight
            step = self._predict_batch(share)
            loss = optimization.compute_loss(step)
            for name, value in _numbers(optimization, loss, step).items():
                sums[name] = sums.get(name, 0.0) + value * size
            count += size
        self.network.set_train()
        *totals, total = self.group.total([*sums.values(), count])
        return {name: value / total for name, value in zip(sums, totals, strict=True)}

    def _counted(self, batch: Batch) -> str:
        """Return the field whose length is the weight of a batch: rows, or a target's entries."""
        targets = [name for name in self.network.opt_fields if name in batch]
        return targets[0] if targets and self._free else next(iter(batch))

    def distributions(self) -> dict[str, Array]:
        """Return weights and gradients as arrays, ``weights/<name>`` and ``gradients/<name>``."""
        network = self.network
        tensors = {
            **{f"weights/{name}": value for name, value in network.get_parameters().items()},
            **{f"gradients/{name}": value for name, value in network.get_gradients().items()},
        }
        return network.tensor_to_numpy(tensors)

    @property
    def learning_rate(self) -> float | None:
        """The current learning rate; None if the optimization has none."""
        return self._trainer().learning_rate()

    def begin(self, epoch_nb: int, batch_nb: int) -> Sequence[str]:
        """Prepare the optimization for a training; see `Optimization.begin`."""
        return self._trainer().begin(epoch_nb, batch_nb)

    def join(self, group: Group) -> None:
        """Train in a group of processes from now on; fields and parameters must be known.

        Raises:
            ConfigError: If the optimization does not support several processes.
        """
        self.group = group
        if group.size > 1:
            self._trainer().join(group)

    def epoch_end(self, loss: float) -> None:
        """Pass the loss of a finished epoch to the optimization."""
        optimization = self._trainer()
        optimization.schedule(loss)
        optimization.epoch_end(loss)

    def predict_in_training(self, batch: Batch) -> Batch:
        """Return the current network's prediction between two optimization steps.

        The network stays in evaluation mode until the next step, because there may be many
        predictions.

        Raises:
            UsageError: If the fields' shapes are not known yet.
        """
        if not self.fields:
            raise UsageError(
                "Before the first batch, get_prediction() needs the shapes of the network's "
                "fields: set the step's training and additional data first, or define the "
                'fields with Field("name", shape=...).'
            )
        self._is_between_steps = True
        self.network.set_eval()
        return self.answer(batch)

    def compare(self, batch: Batch, batch_size: int) -> tuple[Batch, Batch]:
        """Return predictions for a batch, between two optimization steps, and the true values.

        The keys of both are the names of the true fields; predictions without a true value of the
        same shape are left out.

        Args:
            batch: The batch; at least one row.
            batch_size: Largest number of rows to predict at once.
        """
        network, rows = self.network, len(next(iter(batch.values())))
        parts = (
            [self.predict_in_training(batch)]
            if self._free
            else [
                self.predict_in_training(
                    {n: v[first : first + batch_size] for n, v in batch.items()}
                )
                for first in range(0, rows, batch_size)
            ]
        )
        answer = concatenate(parts)
        pairs = zip(network.opt_fields, network.pred_fields, strict=False)
        predicted = {true: answer[name] for true, name in pairs if true in batch}
        same = [name for name, array in predicted.items() if array.shape == batch[name].shape]
        return {name: predicted[name] for name in same}, {name: batch[name] for name in same}

    def predict(self, batch: Batch) -> Batch:
        """Return the prediction for a batch, both in physical units.

        Raises:
            MissingFieldError: If the batch lacks a field that the network reads.
            FieldShapeError: If the network fails because a field has the wrong shape.
        """
        network = self.network
        batch, sizes = self._pack(batch)
        try:
            read = pick(batch, network.net_fields)
        except KeyError as error:
            raise MissingFieldError(
                f'The network reads the field "{error.args[0]}", which is missing. '
                f"Given: {', '.join(batch) or 'none'}. An environment gives more than it trains "
                "with, such as windows, by define_additional_fields() and set_additional_data().",
                field=str(error.args[0]),
            ) from None
        try:
            inputs = network.numpy_to_tensor(read)
            answer = network.tensor_to_numpy(predict(network, self.transformation, inputs))
            return self._split(answer, sizes) if sizes else answer
        except PhysxError:
            raise
        except Exception:  # from a library; other shapes are fine as long as the network takes them
            self._check_shapes(read, exactly=True)
            raise

    def answer(self, request: Batch) -> Batch:
        """Return the prediction for inputs from an environment, after checking them.

        Raises:
            MissingFieldError: If a field that the network reads is missing.
            FieldShapeError: If a field's shape differs from the one in training, but for the sizes
                of two or more named axes other than the channels.
            FieldTypeError: If a value is not an array of numbers.
        """
        self._check_shapes(request)
        return self.predict(request)

    def _check_shapes(self, inputs: Batch, *, exactly: bool = False) -> None:
        for name in self.network.net_fields:
            values, field = inputs.get(name), self.fields.get(name)
            if values is None or field is None or field.free_axis:
                continue  # what has a free axis is checked when it is packed
            if values.dtype.kind not in NUMBERS:
                raise FieldTypeError(f'field "{name}" does not consist of numbers.', field=name)
            shape = values.shape[1:]
            if not (field.shape in (None, shape) or (field.is_resolution(shape) and not exactly)):
                raise FieldShapeError(
                    f'field "{name}" has shape {shape}, but the network takes {field.shape}.',
                    field=name,
                )

    def save(
        self,
        network_dir: Path,
        progress: checkpoint.Progress | None = None,
        buffer: Index | None = None,
        sampler: Array | None = None,
        streams: bytes | None = None,
        *,
        best: bool = False,
    ) -> Path:
        """Write the next checkpoint, or the best one, and return its folder.

        Args:
            network_dir: Folder of the checkpoints.
            progress: Progress of the training; None: the network was not trained here.
            buffer: State of the buffer that draws the batches, if any.
            sampler: State of the sampler that learns from the training, if any.
            streams: What streams need to go on from states, if any.
            best: Whether the network is the best so far, which replaces the previous best one.

        Raises:
            CheckpointError: If it cannot be stored.
        """
        return checkpoint.save(
            network_dir,
            self.config,
            self.network,
            self._trainer(),
            self.fields,
            self.transformation.normalization,
            progress or checkpoint.Progress(0, 0, 0, 0),
            buffer,
            sampler,
            streams,
            best=best,
        )

    def dry_run_save(self, place: Path) -> None:
        """Check that the network can be saved, using a temporary folder in `place`.

        Raises:
            CheckpointError: If it cannot be saved.
        """
        checkpoint.dry_run_save(place, self.network, self._trainer())

    def export(self, path: str | Path, form: str) -> None:
        """Write network and transformation to one file that other programs can run.

        The file's inputs are `Network.net_fields` and its outputs `Network.pred_fields`, in
        physical units, with these names, for any number of samples.

        Args:
            path: The file; an existing one is replaced.
            form: One of `Network.export_forms`.

        Raises:
            ConfigError: If the network cannot be exported in this form.
            MissingLibraryError: If a library required by the form is not installed.
        """
        network = self.network
        if form not in network.export_forms:
            raise ConfigError(
                f'{type(network).__name__} cannot be exported as "{form}". '
                f"Forms: {listed(network.export_forms)}."
            )
        write = import_component("exporter", network.exporter)
        to_physical = partial(predict, network, self.transformation)
        write(Path(path), form, network, to_physical, self.fields)

    def load_parameters(self, found: checkpoint.Checkpoint) -> None:
        """Read the network's parameters from a checkpoint.

        Raises:
            CheckpointError: If it belongs to another network, or was replaced in the meantime.
        """
        self.network.load_parameters(found.path / self.network.parameters_file)
        checkpoint.check_unchanged(found)

    def resume(self, found: checkpoint.Checkpoint) -> None:
        """Continue training exactly where a checkpoint was written; fields must be bound.

        Raises:
            CheckpointError: If it is damaged, or belongs to another network or optimization.
        """
        self.load_parameters(found)
        optimization = self._trainer()
        if optimization.state_file:
            optimization.load_state(found.path / optimization.state_file)


def _numbers(optimization: Optimization, loss: Any, step: PredictedBatch) -> dict[str, float]:
    """Return the result of `Optimization.transform_loss` as plain numbers."""
    losses = optimization.transform_loss(loss, step)
    if not isinstance(losses, Mapping) or "loss" not in losses:
        given = listed(map(str, losses)) if isinstance(losses, Mapping) else type(losses).__name__
        raise UsageError(
            f"{type(optimization).__name__}.transform_loss() must return a dictionary with "
            f'"loss", not {given}.'
        )
    numbers = {}
    for name, value in losses.items():
        try:
            numbers[name] = float(value.item() if hasattr(value, "item") else value)
        except (TypeError, ValueError, RuntimeError) as error:
            raise UsageError(
                f'{type(optimization).__name__}.transform_loss() returned "{name}", which is not '
                f"a number: {error}."
            ) from error
    return numbers
