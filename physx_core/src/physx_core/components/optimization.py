"""Optimization: computes the loss and improves the network's parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from physx_core.components.group import Group
from physx_core.components.network import Network
from physx_core.errors import ConfigError
from physx_core.typing import Tensors


class Optimization(ABC):
    """Base of all optimizations.

    Attributes:
        extra_fields: Fields of the batch that the loss reads beside those of the network.
        state_file: Name of the file that `save_state` writes into a checkpoint; empty where the
            optimization keeps nothing from step to step.
    """

    state_file: ClassVar[str] = ""
    extra_fields: Sequence[str] = ()

    @abstractmethod
    def set_loss(self, loss: str | type[Any] | None) -> None:
        """Choose the loss function, by class or by its name in the network's library.

        Raises:
            ConfigError: There is no such loss, or one is needed and none was given.
        """

    @abstractmethod
    def set_optimizer(
        self, optimizer: str | type[Any] | None, network: Network, **kwargs: Any
    ) -> None:
        """Choose what changes the network's parameters, by class or by its name.

        Args:
            optimizer: Class or name.
            network: Whose parameters are changed.
            kwargs: Arguments of the optimizer, ``lr`` among them where it was configured.

        Raises:
            ConfigError: There is no such optimizer, or it refuses the arguments.
        """

    def set_scheduler(self, scheduler: str | type[Any], **kwargs: Any) -> None:
        """Choose what changes the learning rate after each epoch, by class or by its name.

        Args:
            scheduler: Class or name.
            kwargs: Arguments of the scheduler.

        Raises:
            ConfigError: There is no such scheduler, or it refuses the arguments.
            UsageError: There is no optimizer yet.
        """
        raise ConfigError(f"{type(self).__name__} has no schedulers: leave out scheduler.")

    @abstractmethod
    def compute_loss(self, prediction: Tensors, targets: Tensors, data: Tensors) -> Any:
        """Return the loss of a prediction.

        Args:
            prediction: The network's `pred_fields`.
            targets: The network's `opt_fields`.
            data: The whole batch, for losses that need more.
        """

    def transform_loss(self, loss: Any, data: Tensors) -> dict[str, Any]:
        """Return the statistics of this step; entries beside ``loss`` are recorded too.

        Called after `optimize`. All entries are numbers, or what ``float`` makes one of.

        Args:
            loss: What `compute_loss` returned.
            data: The whole batch.
        """
        return {"loss": loss}

    @abstractmethod
    def optimize(self, loss: Any) -> None:
        """Change the parameters along the gradient of the loss."""

    def learning_rate(self) -> float | None:
        """Return the present learning rate; None where there is no such thing."""
        return None

    def join(self, group: Group) -> None:
        """Improve the parameters by the gradients of all processes of a group.

        Called once, when the network has its first parameters; those of the leading process count.

        Raises:
            ConfigError: There are several processes, but the optimization cannot work together.
        """
        if group.size > 1:
            raise ConfigError(
                f"{type(self).__name__} cannot work in several processes: leave torchrun out."
            )

    def epoch_end(self, loss: float) -> None:  # noqa: B027
        """An epoch of the training is over, for example for a schedule of the learning rate.

        Args:
            loss: What the epoch is judged by: the loss of its validation, or its mean training loss
                where nothing is validated. NaN: not validated, though other epochs are.
        """

    def save_state(self, path: Path) -> None:  # noqa: B027
        """Write what a later training needs, beside the parameters, to go on exactly here.

        Called only where `state_file` is not empty; the file can be read without running code.
        """

    def load_state(self, path: Path) -> None:  # noqa: B027
        """Read what `save_state` wrote, once loss and optimizer are chosen.

        Raises:
            CheckpointError: The file is missing, damaged or of another optimization.
        """
