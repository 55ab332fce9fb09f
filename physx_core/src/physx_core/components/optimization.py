"""Optimization: base class for computing the loss and updating the network's parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from physx_core.components.group import Group
from physx_core.components.network import Network
from physx_core.components.predicted_batch import PredictedBatch
from physx_core.errors import ConfigError


class Optimization(ABC):
    """Base of all optimizations.

    Attributes:
        extra_fields: Fields of the batch that the loss reads in addition to the network's.
        differentiates_inputs: Whether the loss differentiates predictions with respect to the
            network's inputs in `PredictedBatch.data`, in physical units, in validations too.
        state_file: Name of the file that `save_state` writes into a checkpoint; empty if the
            optimization has no state.
        network: The network to train; set by `set_optimizer`.
        stops_at_nan: Whether a loss or gradient that is not finite ends the training; set by the
            training run.
        scheduler_interval: When the scheduler is stepped, "epoch" or "step"; None: as suits the
            scheduler. Set by the training run before `set_scheduler`.
    """

    state_file: ClassVar[str] = ""
    extra_fields: Sequence[str] = ()
    differentiates_inputs: bool = False
    network: Network
    stops_at_nan: bool = True
    scheduler_interval: str | None = None

    def set_loss(self, loss: Any) -> None:
        """Choose the loss function, by class or by its name in the network's library.

        A table has several by name: see `NetworkConfig.loss`.

        Unless this is implemented, the optimization has its own loss.

        Raises:
            ConfigError: If there is no such loss, or one is needed and none was given.
        """
        if loss is not None:
            raise ConfigError(f"{type(self).__name__} has its own loss: leave out loss.")

    def set_optimizer(
        self, optimizer: str | type[Any] | None, network: Network, **kwargs: Any
    ) -> None:
        """Choose the optimizer of the network's parameters, by class or by its name.

        Unless this is implemented, the optimization is its own optimizer, without arguments.

        Args:
            optimizer: Class or name.
            network: The network to train.
            kwargs: Arguments of the optimizer, including ``lr`` if it was configured.

        Raises:
            ConfigError: If there is no such optimizer, or it rejects the arguments.
        """
        if optimizer is not None or kwargs:
            raise ConfigError(
                f"{type(self).__name__} is its own optimizer: leave out optimizer, "
                "optimizer_kwargs and lr."
            )
        self.network = network

    def set_scheduler(self, scheduler: str | type[Any], **kwargs: Any) -> None:
        """Choose the scheduler of the learning rate, by class or by its name.

        Args:
            scheduler: Class or name.
            kwargs: Arguments of the scheduler.

        Raises:
            ConfigError: If there is no such scheduler, or it rejects the arguments.
            UsageError: If there is no optimizer yet.
        """
        raise ConfigError(f"{type(self).__name__} has no schedulers: leave out scheduler.")

    @abstractmethod
    def compute_loss(self, batch: PredictedBatch) -> Any:
        """Return the loss of a batch, in training and in validation.

        Args:
            batch: Prediction, targets and all other fields, normalized and in physical units.
        """

    def compute_row_losses(self, batch: PredictedBatch) -> Any:
        """Return the loss of each row of a batch, shape (rows,), for samplers that learn from them.

        Called after `compute_loss`, with the same batch, before `optimize`; must not change
        anything.

        Raises:
            ConfigError: If the optimization does not compute them.
        """
        raise ConfigError(
            f"{type(self).__name__} does not compute the loss of each row, from which the "
            "sampler learns: implement compute_row_losses(), or choose another sampler."
        )

    def transform_loss(self, loss: Any, batch: PredictedBatch) -> dict[str, Any]:
        """Return the statistics of this step; entries other than ``loss`` are recorded too.

        Called after `optimize`. All entries are numbers or can be converted with ``float``.

        Args:
            loss: The result of `compute_loss`.
            batch: The same batch, with the prediction from before the step.
        """
        return {"loss": loss}

    @abstractmethod
    def optimize(self, loss: Any) -> None:
        """Update the parameters along the gradient of the loss.

        Raises:
            DivergedError: If the loss or gradient is not finite; the parameters are then unchanged.
                Not raised if `stops_at_nan` is off, nor by optimizations that do not check: the
                training run checks the loss itself.
        """

    def learning_rate(self) -> float | None:
        """Return the current learning rate; None if there is none."""
        return None

    def begin(self, epoch_nb: int, batch_nb: int) -> Sequence[str]:
        """Prepare for a training; return lines that the run prints before the first batch.

        Called once, when loss, optimizer and scheduler are chosen, before `load_state` and `join`.

        Args:
            epoch_nb: Number of epochs, including those before the training was resumed.
            batch_nb: Number of batches in an epoch.

        Raises:
            ConfigError: If the options do not suit the training.
        """
        return ()

    def join(self, group: Group) -> None:
        """Train with the gradients of all processes of a group from now on.

        Called once, when the network has its initial parameters; all processes adopt those of the
        leading one.

        Raises:
            ConfigError: If there are several processes and the optimization does not support it.
        """
        if group.size > 1:
            raise ConfigError(
                f"{type(self).__name__} cannot work in several processes: run it without torchrun."
            )

    def schedule(self, loss: float) -> None:  # noqa: B027
        """Adapt what depends on epochs, such as the learning rate, after each epoch.

        Args:
            loss: Validation loss of the epoch, or its mean training loss if nothing is validated.
                NaN: this epoch is not validated, although others are.
        """

    def epoch_end(self, loss: float) -> None:  # noqa: B027
        """Called after each epoch, after `schedule` and with the same loss.

        An override loses nothing: there is nothing here.
        """

    def save_state(self, path: Path) -> None:  # noqa: B027
        """Write the state that training needs, besides the parameters, to resume exactly here.

        Called only if `state_file` is not empty; the file must be readable without running code.
        """

    def load_state(self, path: Path) -> None:  # noqa: B027
        """Read the state that `save_state` wrote, once loss and optimizer are chosen.

        Raises:
            CheckpointError: If the file is missing, damaged or of another optimization.
        """
