"""TorchOptimization: loss, optimizer and learning-rate scheduler of PyTorch."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from physx_core import Network, Optimization
from physx_core.components import Group
from physx_core.errors import (
    CheckpointError,
    ConfigError,
    FieldsMismatchError,
    UsageError,
    listed,
)
from physx_core.typing import Tensors
from physx_torch.choices import choose, classes_in, make
from physx_torch.networks.network import TorchNetwork
from physx_torch.parallel import average_gradients, take_first_values
from physx_torch.storage.state import random_state, read_state, set_random_state, write_state
from physx_torch.training.training_forward import PRECISIONS, Forward, compiled, in_precision

Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def _forget_gradients(optimizer: torch.optim.Optimizer) -> None:
    # As optimizer.zero_grad() does, without its hooks: they take as long as a small network.
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            parameter.grad = None


class TorchOptimization(Optimization):
    """Gradient descent with any loss, optimizer and scheduler of PyTorch.

    The loss of a network with several prediction fields is the mean of the losses of the fields:
    the i-th of `pred_fields` is compared with the i-th of `opt_fields`. A subclass that returns
    more than ``loss`` from `transform_loss` has that recorded as well.

    Attributes:
        loss: The loss function; None before `set_loss`.
        optimizer: The optimizer; None before `set_optimizer`.
        scheduler: Changes the learning rate after each epoch; None where it stays.
    """

    state_file: ClassVar[str] = "optimization.safetensors"

    def __init__(
        self,
        gradient_clip: float | None = None,
        accumulate: int = 1,
        mixed_precision: str | None = None,
        compile: bool | str = False,
        loss_kwargs: Mapping[str, Any] | None = None,
    ) -> None:
        """Keep the options.

        Args:
            gradient_clip: Longest Euclidean norm of all gradients together; longer ones are
                scaled down to it. None: they are taken as they are.
            accumulate: Batches whose mean gradient makes one step of the optimizer. Those left at
                the end of an epoch wait for the next one's.
            mixed_precision: ``"bfloat16"`` or ``"float16"``: the network computes in it what needs
                no more digits, while it is trained; parameters and loss stay float32. Gradients
                are scaled for float16, which has a small range. None: all in the network's type.
            compile: Whether ``torch.compile`` makes the network faster while it is trained, or the
                name of the backend that does; True is ``"inductor"``.
            loss_kwargs: Keyword arguments of the loss, where it is a class.

        Raises:
            ConfigError: An option has an unfit value.
        """
        if gradient_clip is not None and not gradient_clip > 0:
            raise ConfigError(f"gradient_clip is {gradient_clip!r} but must be positive.")
        if type(accumulate) is not int or accumulate < 1:
            raise ConfigError(f"accumulate is {accumulate!r} but must be a positive integer.")
        if mixed_precision not in (None, *PRECISIONS):
            raise ConfigError(
                f"mixed_precision is {mixed_precision!r} but must be {listed(PRECISIONS)} or None."
            )
        self.loss: Loss | None = None
        self.optimizer: torch.optim.Optimizer | None = None
        self.scheduler: LRScheduler | None = None
        self._gradient_clip = gradient_clip
        self._accumulate, self._accumulated = accumulate, 0
        self._precision = PRECISIONS[mixed_precision] if mixed_precision else None
        self._backend = "inductor" if compile is True else compile
        self._loss_kwargs = dict(loss_kwargs or {})
        self._network: TorchNetwork | None = None
        self._scaler: torch.amp.GradScaler | None = None
        self._is_shared = False

    def set_loss(self, loss: str | type[Any] | Loss | None) -> None:
        """Choose the loss function.

        Args:
            loss: Name of a class in `torch.nn` such as ``"MSELoss"``; ``"package.module:Name"``; a
                class; a module; or a function of prediction and target.

        Raises:
            ConfigError: There is no such loss, it refuses `loss_kwargs`, or none was given.
        """
        known = classes_in(torch.nn.modules.loss, torch.nn.Module)
        if loss is None:
            raise ConfigError('A training needs a loss, for example loss="MSELoss".')
        chosen = choose("loss", loss, known)
        if isinstance(chosen, type):
            chosen = make("loss", chosen, **self._loss_kwargs)
        elif self._loss_kwargs:
            raise ConfigError(f"loss_kwargs are for a loss that is a class, not {chosen!r}.")
        if not callable(chosen):
            raise ConfigError(f"The loss {loss!r} cannot be called with prediction and target.")
        self.loss = chosen
        self._place_loss()

    def _place_loss(self) -> None:
        # Losses may hold tensors of their own, for example weights of classes.
        if isinstance(self.loss, torch.nn.Module) and self._network is not None:
            self.loss.to(self._network.device, self._network.data_type)

    def set_optimizer(
        self, optimizer: str | type[Any] | None, network: Network, **kwargs: Any
    ) -> None:
        """Choose the optimizer, and how the network computes while it is trained.

        Args:
            optimizer: Class, name in `torch.optim` such as ``"Adam"``, or
                ``"package.module:Class"``.
            network: Whose parameters are changed.
            kwargs: Arguments of the optimizer, ``lr`` among them.

        Raises:
            ConfigError: There is no such optimizer, it refuses the arguments, the network has no
                parameters, or cannot compute as the options say.
        """
        if optimizer is None:
            raise ConfigError('A training needs an optimizer, for example optimizer="Adam".')
        if not isinstance(network, TorchNetwork):
            raise ConfigError(f"{type(network).__name__} is no TorchNetwork.")
        chosen = choose("optimizer", optimizer, classes_in(torch.optim, torch.optim.Optimizer))
        trained = [p for p in network.parameters() if p.requires_grad]
        made = make("optimizer", chosen, trained, **kwargs)
        if not isinstance(made, torch.optim.Optimizer):
            raise ConfigError(f"{optimizer!r} made a {type(made).__name__}, not an optimizer.")
        closure = inspect.signature(made.step).parameters.get("closure")
        if closure is not None and closure.default is inspect.Parameter.empty:
            raise ConfigError(
                f"{type(made).__name__} evaluates the loss several times in a step, which physx "
                "does not do. Choose another optimizer."
            )
        self.optimizer = made
        self._network = network
        self._place_loss()
        self._set_forward(network)

    def _set_forward(self, network: TorchNetwork) -> None:
        forward: Forward | None = None
        if self._backend:
            forward = compiled(network.forward, self._backend)
        if self._precision is not None:
            if network.data_type != torch.float32:
                raise ConfigError('mixed_precision needs data_type="float32".')
            device = network.device
            forward = in_precision(
                forward or network.forward, device, self._precision, network.data_type
            )
            if self._precision == torch.float16:
                self._scaler = torch.amp.GradScaler(device.type)
        network.set_training_forward(forward)

    def set_scheduler(self, scheduler: str | type[Any], **kwargs: Any) -> None:
        """Choose what changes the learning rate after each epoch.

        Args:
            scheduler: Class, or name in `torch.optim.lr_scheduler` such as
                ``"CosineAnnealingLR"``. ``"ReduceLROnPlateau"`` looks at the loss of the
                validation, or else at the mean training loss of the epoch.
            kwargs: Arguments of the scheduler.

        Raises:
            ConfigError: There is no such scheduler, or it refuses the arguments.
            UsageError: There is no optimizer yet.
        """
        if self.optimizer is None:
            raise UsageError("set_scheduler() needs set_optimizer() before it.")
        chosen = choose("scheduler", scheduler, classes_in(torch.optim.lr_scheduler, LRScheduler))
        made = make("scheduler", chosen, self.optimizer, **kwargs)
        if not isinstance(made, LRScheduler):
            raise ConfigError(f"{scheduler!r} made a {type(made).__name__}, not a scheduler.")
        self.scheduler = made

    def compute_loss(self, prediction: Tensors, targets: Tensors, data: Tensors) -> torch.Tensor:
        """Return the mean over the prediction fields of their losses.

        Args:
            prediction: The network's `pred_fields`.
            targets: The network's `opt_fields`.
            data: The whole batch; not used.

        Raises:
            UsageError: Loss or optimizer were not chosen yet.
            FieldsMismatchError: A prediction has another shape than what it is compared with.
        """
        if self.loss is None or self._network is None:
            raise UsageError("compute_loss() needs set_loss() and set_optimizer() before it.")
        losses = []
        names = zip(self._network.pred_fields, self._network.opt_fields, strict=True)
        for pred_name, opt_name in names:
            pred, target = prediction[pred_name], targets[opt_name]
            # With class indices, which are integers, the shapes differ rightly.
            if pred.shape != target.shape and target.is_floating_point():
                text = f'shape {tuple(pred.shape)}, but "{opt_name}" has {tuple(target.shape)}'
                raise FieldsMismatchError("Prediction and target differ", {pred_name: text})
            losses.append(self.loss(pred, target))
        return losses[0] if len(losses) == 1 else torch.stack(losses).mean()

    def transform_loss(self, loss: torch.Tensor, data: Tensors) -> dict[str, Any]:
        """Return ``{"loss": <number>}``."""
        return {"loss": loss.item()}

    def optimize(self, loss: torch.Tensor) -> None:
        """Change the parameters along the gradient of the loss, or of several batches' mean loss.

        Raises:
            UsageError: There is no optimizer yet.
        """
        if self.optimizer is None or self._network is None:
            raise UsageError("optimize() needs set_optimizer() before it.")
        if self._accumulated == 0:
            _forget_gradients(self.optimizer)
        if self._accumulate > 1:
            loss = loss / self._accumulate
        if self._scaler is not None:
            loss = self._scaler.scale(loss)
        loss.backward()
        if self._is_shared:
            average_gradients(self._network)
        self._accumulated += 1
        if self._accumulated >= self._accumulate:
            self._accumulated = 0
            self._step(self.optimizer, self._network)

    def _step(self, optimizer: torch.optim.Optimizer, network: TorchNetwork) -> None:
        """Change the parameters along the gradients that they have."""
        if self._gradient_clip is not None:
            if self._scaler is not None:
                self._scaler.unscale_(optimizer)
            torch.nn.utils.clip_grad_norm_(network.parameters(), self._gradient_clip)
        if self._scaler is None:
            optimizer.step()
        else:
            self._scaler.step(optimizer)
            self._scaler.update()

    def join(self, group: Group) -> None:
        """Use the mean of the gradients of all processes from here on; see `Optimization.join`.

        Raises:
            UsageError: There is no optimizer yet.
        """
        if self._network is None:
            raise UsageError("join() needs set_optimizer() before it.")
        self._is_shared = group.size > 1
        if self._is_shared:
            take_first_values(self._network)

    def __str__(self) -> str:
        scheduler = type(self.scheduler).__name__ if self.scheduler is not None else "no scheduler"
        return f"{self.loss}, {scheduler}\n{self.optimizer}"

    def learning_rate(self) -> float | None:
        """Return the learning rate of the optimizer's first group of parameters."""
        if self.optimizer is None:
            return None
        return float(self.optimizer.param_groups[0]["lr"])

    def epoch_end(self, loss: float) -> None:
        """Let the scheduler change the learning rate; see `Optimization.epoch_end`."""
        if isinstance(self.scheduler, ReduceLROnPlateau):
            if not math.isnan(loss):
                self.scheduler.step(loss)
        elif self.scheduler is not None:
            self.scheduler.step()

    def save_state(self, path: Path) -> None:
        """Write the state of optimizer, scheduler, unfinished step and torch's random numbers.

        Raises:
            UsageError: There is no optimizer yet.
            CheckpointError: A part of the state cannot be written as plain data.
        """
        if self.optimizer is None or self._network is None:
            raise UsageError("save_state() needs set_optimizer() before it.")
        state: dict[str, Any] = {
            "kinds": self._kinds(),
            "optimizer": self.optimizer.state_dict(),
            "random": random_state(self._network.device),
        }
        for name, item in (("scheduler", self.scheduler), ("scaler", self._scaler)):
            if item is not None:
                state[name] = item.state_dict()
        if self._accumulated:
            state["accumulated"] = self._accumulated
            state["gradients"] = self._network.get_gradients()
        write_state(path, state)

    def load_state(self, path: Path) -> None:
        """Go on where `save_state` was called, also with torch's random numbers.

        Raises:
            UsageError: There is no optimizer yet.
            CheckpointError: The file is missing, damaged, or of another optimizer or scheduler.
        """
        if self.optimizer is None or self._network is None:
            raise UsageError("load_state() needs set_optimizer() before it.")
        state = read_state(path)
        if state.get("kinds") != self._kinds():
            found, own = (" and ".join(kinds) for kinds in (state.get("kinds", []), self._kinds()))
            raise CheckpointError(f"{path} holds the state of {found or 'nothing'}, not of {own}.")
        try:
            self.optimizer.load_state_dict(state["optimizer"])
            self._accumulated = state.get("accumulated", 0)
            self._network.set_gradients(state.get("gradients", {}))
        except (KeyError, ValueError) as error:
            raise CheckpointError(f"{path} is of another network: {error}.") from error
        for name, item in (("scheduler", self.scheduler), ("scaler", self._scaler)):
            if item is not None:
                item.load_state_dict(state[name])
        set_random_state(state["random"], self._network.device)

    def _kinds(self) -> list[str]:
        used = (self.optimizer, self.scheduler, self._scaler)
        return [type(item).__name__ for item in used if item is not None]
