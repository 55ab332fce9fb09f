"""Learner: a network with its transformation and, for training, its optimization."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from physx_core import checkpoint
from physx_core.config import NetworkConfig
from physx_core.errors import ConfigError, MissingFieldError, UsageError
from physx_core.fields import Batch, Field
from physx_core.interfaces.network import Network
from physx_core.interfaces.optimization import Optimization
from physx_core.interfaces.transformation import Transformation
from physx_core.plugins import resolve
from physx_core.statistics import Normalization


class Learner:
    """Everything that a `NetworkConfig` describes, working together.

    Attributes:
        config: The configuration, with references in the place of None.
        network: The network.
        transformation: Works between physical units and the network.
        optimization: Improves the network; None where nothing is trained.
        fields: The fields that the network was bound to, by name.
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
        self.network: Network = _make("network", config.network, config.network_kwargs, Network)
        reference = config.transformation or self.network.default_transformation
        self.transformation: Transformation = _make(
            "transformation", reference, config.transformation_kwargs, Transformation
        )
        self.config = dataclasses.replace(config, transformation=reference)
        self.network.set_data_type(config.data_type)
        self.network.set_device(config.device)
        self.optimization: Optimization | None = None
        self.fields: dict[str, Field] = {}
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
        loss, data = self.loss(batch)
        optimization = self._trainer()
        optimization.optimize(loss)
        return optimization.transform_loss(loss, data)

    def mean_loss(self, batches: Iterable[Batch]) -> float:
        """Return the mean loss over all samples of some batches; the network learns nothing."""
        self.network.set_eval()
        total, count = 0.0, 0
        for batch in batches:
            size = len(next(iter(batch.values())))
            loss, _ = self.loss(batch)
            total += float(loss) * size
            count += size
        self.network.set_train()
        return total / count

    def epoch_end(self) -> None:
        """Tell the optimization that an epoch is over."""
        self._trainer().epoch_end()

    def predict_in_training(self, batch: Batch) -> Batch:
        """Return the prediction of the network as it is now, between two optimization steps."""
        self.network.set_eval()
        try:
            return self.predict(batch)
        finally:
            self.network.set_train()

    def predict(self, batch: Batch) -> Batch:
        """Return the prediction for a batch, both in physical units.

        Raises:
            MissingFieldError: The batch lacks a field that the network reads.
        """
        network = self.network
        missing = [name for name in network.net_fields if name not in batch]
        if missing:
            raise MissingFieldError(
                f'The network reads the field "{missing[0]}", which is not given. '
                f"Given: {', '.join(batch) or 'none'}.",
                field=missing[0],
            )
        inputs = network.numpy_to_tensor({name: batch[name] for name in network.net_fields})
        prediction = network.predict(self.transformation.transform_before_prediction(inputs))
        return network.tensor_to_numpy(self.transformation.transform_before_apply(prediction))

    def save(self, network_dir: Path, progress: checkpoint.Progress) -> Path:
        """Write the next checkpoint and return its folder."""
        return checkpoint.save(
            network_dir,
            self.config,
            self.network,
            self._trainer(),
            self.fields,
            self.transformation.normalization,
            progress,
        )

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


def _make(kind: str, reference: Any, arguments: dict[str, Any], base: type[Any]) -> Any:
    make = resolve(kind, reference)
    try:
        component = make(**arguments)
    except TypeError as error:
        raise ConfigError(f"The {kind} {reference!r} refuses its arguments: {error}.") from error
    if not isinstance(component, base):
        raise ConfigError(
            f"{reference!r} made a {type(component).__name__}, which is no physx {kind}. "
            "A class of the library itself goes through its plugin, for example "
            'network="torch/module", network_kwargs={"module": "package.module:Class"}.'
        )
    return component
