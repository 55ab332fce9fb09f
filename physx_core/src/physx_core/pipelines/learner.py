"""Learner: a network with its transformation and, for training, its optimization."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from physx_core import checkpoint
from physx_core.components.group import Group
from physx_core.components.network import Network
from physx_core.components.optimization import Optimization
from physx_core.components.transformation import Transformation
from physx_core.config import NetworkConfig
from physx_core.errors import ConfigError, MissingFieldError, UsageError
from physx_core.fields import Field
from physx_core.plugins import resolve
from physx_core.plugins.networks import resolve_network
from physx_core.statistics import Normalization
from physx_core.typing import Array, Batch


class Learner:
    """Everything that a `NetworkConfig` describes, working together.

    Attributes:
        config: The configuration, with references in the place of None.
        network: The network.
        transformation: Works between physical units and the network.
        optimization: Improves the network; None where nothing is trained.
        fields: The fields that the network was bound to, by name.
        group: The processes that train the network together.
    """

    def __init__(self, config: NetworkConfig, *, trains: bool) -> None:
        """Make the components.

        Args:
            config: What to make.
            trains: Whether an optimization is made too.

        Raises:
            ConfigError: No network is configured, or a component refuses its arguments.
            PhysxError: A reference leads nowhere.
        """
        if config.network is None:
            raise ConfigError(
                'NetworkConfig.network is missing: name a network, for example "torch/fc".'
            )
        make, arguments = resolve_network(config.network, config.network_kwargs)
        self.network: Network = _made("network", config.network, make, arguments, Network)
        reference = config.transformation or self.network.default_transformation
        self.transformation: Transformation = _make(
            "transformation", reference, config.transformation_kwargs, Transformation
        )
        self.config = dataclasses.replace(config, transformation=reference)
        self.network.set_data_type(config.data_type)
        self.network.set_device(config.device)
        self.optimization: Optimization | None = None
        self.fields: dict[str, Field] = {}
        self.group = Group()
        self._is_between_steps = False
        if trains:
            self.optimization = self._make_optimization(config)

    def _make_optimization(self, config: NetworkConfig) -> Optimization:
        reference = config.optimization or self.network.default_optimization
        optimization: Optimization = _make(
            "optimization", reference, config.optimization_kwargs, Optimization
        )
        arguments = dict(config.optimizer_kwargs)
        if config.lr is not None:
            arguments["lr"] = config.lr
        if config.loss is not None or config.require_training_stuff:
            optimization.set_loss(config.loss)
        if config.optimizer is not None or config.require_training_stuff:
            optimization.set_optimizer(config.optimizer, self.network, **arguments)
        if config.scheduler is not None:
            optimization.set_scheduler(config.scheduler, **config.scheduler_kwargs)
        elif config.scheduler_kwargs:
            raise ConfigError("NetworkConfig.scheduler_kwargs are given without scheduler.")
        return optimization

    def bind(self, fields: Mapping[str, Field], normalization: Mapping[str, Normalization]) -> None:
        """Tell the components the fields' shapes and normalization.

        Raises:
            FieldsMismatchError: The network needs fields of other names or shapes.
        """
        self.fields = dict(fields)
        self.network.bind(fields)
        self.normalize(normalization)

    def normalize(self, normalization: Mapping[str, Normalization]) -> None:
        """Tell the transformation the normalization of the network's fields."""
        used = {*self.network.net_fields, *self.network.opt_fields}
        mine = {name: item for name, item in normalization.items() if name in used}
        self.transformation.set_normalization(mine, self.network)

    @property
    def batch_fields(self) -> list[str]:
        """Names of the fields that a training batch must hold."""
        extra = self.optimization.extra_fields if self.optimization is not None else ()
        names = (*self.network.net_fields, *self.network.opt_fields, *extra)
        return list(dict.fromkeys(names))

    def loss(self, batch: Batch) -> tuple[Any, dict[str, Any]]:
        """Return the loss of a batch in physical units, and the batch as tensors.

        Raises:
            UsageError: There is no optimization.
        """
        network, transformation = self.network, self.transformation
        data = network.numpy_to_tensor(batch)
        inputs = {name: data[name] for name in network.net_fields}
        targets = {name: data[name] for name in network.opt_fields}
        prediction = network.predict(transformation.transform_before_prediction(inputs))
        prediction, targets = transformation.transform_before_loss(prediction, targets)
        return self._trainer().compute_loss(prediction, targets, data), data

    def _trainer(self) -> Optimization:
        if self.optimization is None:
            raise UsageError("This network was made to predict, not to be trained.")
        return self.optimization

    def optimize(self, batch: Batch) -> dict[str, Any]:
        """Let the network learn from a batch; return the statistics of the step, ``loss`` first.

        Raises:
            UsageError: There is no optimization.
        """
        if self._is_between_steps:
            self._is_between_steps = False
            self.network.set_train()
        if self.group.size > 1:
            return self._optimize_together(batch)
        loss, data = self.loss(batch)
        optimization = self._trainer()
        optimization.optimize(loss)
        return optimization.transform_loss(loss, data)

    def _optimize_together(self, batch: Batch) -> dict[str, Any]:
        """Learn from this process's share of the batch; the statistics are those of the whole."""
        share, weight = self.group.share_of(batch)
        loss, data = self.loss(share)
        optimization = self._trainer()
        optimization.optimize(loss * (weight * self.group.size))  # their mean is that of the batch
        losses = optimization.transform_loss(loss, data)
        totals = self.group.total([float(value) * weight for value in losses.values()])
        return dict(zip(losses, totals, strict=True))

    def mean_losses(self, batches: Iterable[Batch]) -> dict[str, float]:
        """Return the mean statistics over all samples of some batches, ``loss`` first.

        The network learns nothing. Processes that train together take their share of each batch.
        """
        self.network.set_eval()
        optimization = self._trainer()
        sums: dict[str, float] = {}
        count = 0.0
        for batch in batches:
            share, size = batch, float(len(next(iter(batch.values()))))
            if self.group.size > 1:
                share, weight = self.group.share_of(batch)
                size *= weight
            for name, value in optimization.transform_loss(*self.loss(share)).items():
                sums[name] = sums.get(name, 0.0) + float(value) * size
            count += size
        self.network.set_train()
        *totals, total = self.group.total([*sums.values(), count])
        return {name: value / total for name, value in zip(sums, totals, strict=True)}

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
        """The present learning rate; None where there is no such thing."""
        return self._trainer().learning_rate()

    def join(self, group: Group) -> None:
        """Train together with other processes from here on; fields and parameters are known.

        Raises:
            ConfigError: The optimization cannot do that.
        """
        self.group = group
        if group.size > 1:
            self._trainer().join(group)

    def epoch_end(self, loss: float) -> None:
        """Tell the optimization that an epoch is over, and the loss that it is judged by."""
        self._trainer().epoch_end(loss)

    def predict_in_training(self, batch: Batch) -> Batch:
        """Return the prediction of the network as it is now, between two optimization steps.

        There may be many between two steps, so the network stays ready to predict until the next.

        Raises:
            UsageError: The fields' shapes are not known yet.
        """
        if not self.fields:
            raise UsageError(
                "get_prediction() before the first batch is made needs the shapes of the network's "
                'fields: define them with Field("name", shape=...).'
            )
        self._is_between_steps = True
        self.network.set_eval()
        return self.predict(batch)

    def predict(self, batch: Batch) -> Batch:
        """Return the prediction for a batch, both in physical units.

        Raises:
            MissingFieldError: The batch lacks a field that the network reads.
        """
        network = self.network
        try:
            read = {name: batch[name] for name in network.net_fields}
        except KeyError as error:
            raise MissingFieldError(
                f'The network reads the field "{error.args[0]}", which is not given. '
                f"Given: {', '.join(batch) or 'none'}.",
                field=str(error.args[0]),
            ) from None
        inputs = network.numpy_to_tensor(read)
        prediction = network.predict(self.transformation.transform_before_prediction(inputs))
        return network.tensor_to_numpy(self.transformation.transform_before_apply(prediction))

    def save(self, network_dir: Path, progress: checkpoint.Progress, *, best: bool = False) -> Path:
        """Write the next checkpoint, or the best one, and return its folder."""
        return checkpoint.save(
            network_dir,
            self.config,
            self.network,
            self._trainer(),
            self.fields,
            self.transformation.normalization,
            progress,
            best=best,
        )

    def export(self, path: Path, form: str) -> None:
        """Write network and transformation as one file: see `Network.export`."""
        self.network.export(path, form, self.transformation, self.fields)

    def resume(self, found: checkpoint.Checkpoint) -> None:
        """Go on exactly where a checkpoint was written; the fields are bound already.

        Raises:
            CheckpointError: It is damaged, or of another network or optimization.
        """
        self.network.load_parameters(found.path / self.network.parameters_file)
        optimization = self._trainer()
        if optimization.state_file:
            optimization.load_state(found.path / optimization.state_file)


def restored(config: NetworkConfig, path: Path) -> Learner:
    """Return the network of a checkpoint, ready to predict.

    Args:
        config: What it leaves open is taken from the checkpoint.
        path: The checkpoint's folder.

    Raises:
        CheckpointError: The checkpoint is damaged or of another network.
        FieldsMismatchError: The network reads other fields.
    """
    found = checkpoint.read(path)
    kept = dict(found.network)
    if config.network is not None:
        kept |= {"network": config.network, "network_kwargs": config.network_kwargs}
    if config.transformation is not None:
        kept |= {
            "transformation": config.transformation,
            "transformation_kwargs": config.transformation_kwargs,
        }
    learner = Learner(dataclasses.replace(config, **kept), trains=False)
    learner.bind(found.fields, found.normalization)
    learner.network.load_parameters(path / learner.network.parameters_file)
    learner.network.set_eval()
    return learner


def load_learner(folder: str | Path, config: NetworkConfig | None = None) -> Learner:
    """Return the trained network of a session, ready to predict.

    Args:
        folder: The session's folder, or that of its checkpoints.
        config: Which checkpoint, and what else to change; None: the last one.

    Raises:
        CheckpointError: There is no checkpoint, or it is damaged or of another network.
        FieldsMismatchError: The network reads other fields.
    """
    config = config or NetworkConfig()
    place = Path(config.network_dir or folder)
    return restored(config, checkpoint.find(place, config.network_name, config.which_network))


def _make(kind: str, reference: Any, arguments: dict[str, Any], base: type[Any]) -> Any:
    return _made(kind, reference, resolve(kind, reference), arguments, base)


def _made(kind: str, reference: Any, make: Any, arguments: dict[str, Any], base: type[Any]) -> Any:
    try:
        component = make(**arguments)
    except TypeError as error:
        raise ConfigError(f"The {kind} {reference!r} refuses its arguments: {error}.") from error
    if not isinstance(component, base):
        raise ConfigError(
            f"{reference!r} made a {type(component).__name__}, which is no physx {kind}. "
            "A function that makes one of the library's own goes through its plugin, for example "
            'network="torch/module", network_kwargs={"module": "package.module:function"}.'
        )
    return component
