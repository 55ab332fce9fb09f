"""TorchOptimization: PyTorch's losses, optimizers and learning-rate schedulers."""

from __future__ import annotations

import copy
import functools
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from physx_core import Network, Optimization
from physx_core.components import Group, PredictedBatch
from physx_core.errors import (
    CheckpointError,
    ConfigError,
    DivergedError,
    FieldsMismatchError,
    UsageError,
    listed,
)
from physx_torch.choices import choose, find_classes, make
from physx_torch.networks.network import TorchNetwork
from physx_torch.parallel import average_gradients, broadcast_parameters
from physx_torch.storage.attributes import Attributes
from physx_torch.storage.state import random_state, read_state, set_random_state, write_state
from physx_torch.training.schedules import TrainingLength, choose_interval
from physx_torch.training.training_forward import (
    PRECISIONS,
    Forward,
    compile_forward,
    run_in_precision,
)

_LEAST_SCALE = 1e-9
_ANOTHER = (
    "Start another training from its network: NetworkConfig.network_dir (--network.network-dir)."
)
Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def _clear_gradients(optimizer: torch.optim.Optimizer) -> None:
    # Like optimizer.zero_grad(), without its hooks, which take as long as a small network.
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            parameter.grad = None


def _without_reduction(loss: Loss) -> Loss | None:
    """Return a loss that returns each element's own loss; None if that is not known to work."""
    if not isinstance(loss, torch.nn.Module) or getattr(loss, "reduction", "") != "mean":
        return None
    if (
        type(loss).__module__ != "torch.nn.modules.loss"
        or getattr(loss, "weight", None) is not None
    ):
        return None
    single: Any = copy.copy(loss)
    single.reduction = "none"
    return single


def _pairs(network: TorchNetwork) -> Iterable[tuple[str, str]]:
    """Return the names of each prediction and of the target that it is compared with."""
    predicted, targets = network.pred_fields, network.opt_fields
    if len(predicted) != len(targets):
        raise ConfigError(
            f"{type(network).__name__} predicts {listed(predicted)} but is compared with "
            f"{listed(targets)}: each of pred_fields needs one of opt_fields. For a loss of all of "
            "them together, derive from TorchOptimization and implement compute_loss(batch)."
        )
    return zip(predicted, targets, strict=True)


def _as_target(target: torch.Tensor, prediction: torch.Tensor, loss: Loss) -> torch.Tensor:
    """Return integers and booleans as numbers if they have the prediction's shape, else as labels.

    Args:
        target: The target.
        prediction: What it is compared with.
        loss: The loss function, which may need labels of the prediction's shape.
    """
    if target.is_floating_point() or target.is_complex():
        return target
    if target.shape != prediction.shape or isinstance(loss, torch.nn.MultiLabelMarginLoss):
        return target.to(torch.int64)
    return target.to(prediction.dtype)


class TorchOptimization(Optimization):
    """Gradient descent with any PyTorch loss, optimizer and scheduler.

    The loss of a network with several prediction fields is the mean of the fields' losses: the i-th
    of `pred_fields` is compared with the i-th of `opt_fields`. If a subclass returns more than
    ``loss`` from `transform_loss`, that is recorded too.

    Parameters of the loss are trained with the network's, by the same optimizer.

    A subclass may have further state: `save_state` finds it in the attributes of the optimization
    and of a loss that is a module. It saves optimizers, schedulers, modules such as averaged
    models, and other objects with ``state_dict``, if they are created before the training, for
    example in `set_optimizer`; tensors, arrays and generators of random numbers; lists and
    dictionaries of these; and plain data that have changed since the training began. Anything else
    that is state is an error before or after the first batch.

    Validation, the checkpoint "best", predictions and exports use the parameters of the network.
    Averaged ones must be copied into the network to be used, for example in
    `Training.train_end`, before the last checkpoint.

    Attributes:
        network: The network to train; set by `set_optimizer`.
        loss: The loss function; None before `set_loss`.
        optimizer: The optimizer; None before `set_optimizer`.
        scheduler: Learning-rate scheduler; None if the rate is constant.
        unsaved: Names of attributes that are not state, such as ``"history"`` or
            ``"loss.history"``: they are not saved in checkpoints.
    """

    state_file: ClassVar[str] = "optimization.safetensors"
    unsaved: ClassVar[Sequence[str]] = ()

    def __init__(
        self,
        gradient_clip: float | None = None,
        accumulate: int = 1,
        mixed_precision: str | None = None,
        compile: bool | str = False,
        loss_kwargs: Mapping[str, Any] | None = None,
    ) -> None:
        """Set the options.

        Args:
            gradient_clip: Largest Euclidean norm of all gradients together; larger gradients are
                scaled down to it. None: no limit.
            accumulate: Number of batches whose mean gradient is used in one step of the optimizer.
                Batches left over at the end of an epoch carry over to the next one.
            mixed_precision: ``"bfloat16"`` or ``"float16"``: type of those operations in training
                that do not need more digits; parameters and loss stay float32. For float16, whose
                range is small, gradients are scaled. None: use the network's type everywhere.
            compile: Whether to compile the network for training with ``torch.compile``, or the name
                of its backend; True is ``"inductor"``.
            loss_kwargs: Keyword arguments of the loss, if it is a class.

        Raises:
            ConfigError: If an option is invalid.
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
        self._sums = False
        self._learned_by_loss: dict[str, torch.nn.Parameter] = {}
        self._shared: torch.nn.Module | None = None  # what all processes have in common
        self._total = (0, 0)  # epochs of the training, batches in each
        self._attributes: Attributes | None = None
        self._has_saved = False
        self._known: tuple[torch.Tensor | None, float] = (None, 0.0)  # the loss that was last read

    def set_loss(self, loss: str | type[Any] | Loss | None) -> None:
        """Choose the loss function.

        Args:
            loss: Name of a class in `torch.nn` such as ``"MSELoss"``; ``"package.module:Name"``; a
                class; a module; or a function of prediction and target.

        Raises:
            ConfigError: If the loss does not exist, rejects `loss_kwargs`, or is None.
        """
        known = find_classes(torch.nn.modules.loss, torch.nn.Module)
        if loss is None:
            raise ConfigError(
                'A training needs a loss, for example loss="MSELoss" (--network.loss MSELoss).'
            )
        chosen = choose("loss", loss, known)
        if isinstance(chosen, type):
            chosen = make("loss", object, chosen, **self._loss_kwargs)
        elif self._loss_kwargs:
            raise ConfigError(f"loss_kwargs needs a loss that is a class, not {chosen!r}.")
        if not callable(chosen):
            raise ConfigError(f"The loss {loss!r} cannot be called with prediction and target.")
        self.loss = chosen
        options = getattr(chosen, "keywords", {})  # of a functools.partial
        self._sums = getattr(chosen, "reduction", options.get("reduction")) == "sum"
        self._place_loss()
        if self.optimizer is not None and self._learned_by_loss:
            self.optimizer.add_param_group({"params": list(self._learned_by_loss.values())})

    def _place_loss(self) -> None:
        # Losses may have their own tensors, for example class weights, and learn some of them.
        loss, network = self.loss, self._network
        self._learned_by_loss = {}
        if isinstance(loss, torch.nn.Module) and network is not None:
            loss.to(network.device, network.data_type)
            others = {id(parameter) for parameter in network.parameters()}
            self._learned_by_loss = {
                name: parameter
                for name, parameter in loss.named_parameters()
                if parameter.requires_grad and id(parameter) not in others
            }

    def set_optimizer(
        self, optimizer: str | type[Any] | None, network: Network, **kwargs: Any
    ) -> None:
        """Choose the optimizer, and compile the network as configured.

        Args:
            optimizer: Class, name in `torch.optim` such as ``"Adam"``, or
                ``"package.module:Class"``.
            network: The network to train.
            kwargs: Arguments of the optimizer, including ``lr``.

        Raises:
            ConfigError: If the optimizer does not exist or rejects the arguments, or the network
                has no parameters or does not support the options.
        """
        if optimizer is None:
            raise ConfigError(
                'A training needs an optimizer, for example optimizer="Adam" '
                "(--network.optimizer Adam)."
            )
        if not isinstance(network, TorchNetwork):
            raise ConfigError(f"{type(network).__name__} is not a TorchNetwork.")
        chosen = choose("optimizer", optimizer, find_classes(torch.optim, torch.optim.Optimizer))
        self._network = self.network = network
        self._place_loss()
        trained = [p for p in network.parameters() if p.requires_grad]
        trained += self._learned_by_loss.values()
        made = make("optimizer", torch.optim.Optimizer, chosen, trained, **kwargs)
        if not isinstance(made, torch.optim.Optimizer):
            raise ConfigError(f"{optimizer!r} returned {type(made).__name__}, not an optimizer.")
        closure = inspect.signature(made.step).parameters.get("closure")
        if closure is not None and closure.default is inspect.Parameter.empty:
            raise ConfigError(
                f"{type(made).__name__} evaluates the loss several times in a step, which physx "
                "does not support. Choose another optimizer."
            )
        if type(self).compute_loss is TorchOptimization.compute_loss:
            _pairs(network)
        self.optimizer = made
        self._set_forward(network)

    def _set_forward(self, network: TorchNetwork) -> None:
        forward: Forward | None = None
        if self._backend:
            forward = compile_forward(network.forward, self._backend)
        if self._precision is not None:
            if network.data_type != torch.float32:
                raise ConfigError('mixed_precision needs data_type="float32".')
            device = network.device
            forward = run_in_precision(
                forward or network.forward, device, self._precision, network.data_type
            )
            if self._precision == torch.float16:
                self._scaler = torch.amp.GradScaler(device.type)
        network.set_training_forward(forward)

    def set_scheduler(self, scheduler: str | type[Any], **kwargs: Any) -> None:
        """Choose the learning-rate scheduler.

        It is stepped with the optimizer or after each epoch, as `scheduler_interval` says. By
        default, OneCycleLR, CyclicLR and schedulers with arguments such as ``total_steps`` or
        ``num_warmup_steps`` are stepped with the optimizer, others after each epoch.

        Args:
            scheduler: Class, or name in `torch.optim.lr_scheduler` such as
                ``"CosineAnnealingLR"``. ``"ReduceLROnPlateau"`` gets the validation loss, else the
                mean training loss of the epoch.
            kwargs: Arguments of the scheduler.

        Raises:
            ConfigError: If the scheduler does not exist, rejects the arguments, or cannot be
                stepped as `scheduler_interval` says.
            UsageError: If there is no optimizer yet.
        """
        if self.optimizer is None:
            raise UsageError("set_scheduler() must be called after set_optimizer().")
        chosen = choose("scheduler", scheduler, find_classes(torch.optim.lr_scheduler, LRScheduler))
        made = make("scheduler", LRScheduler, chosen, self.optimizer, **kwargs)
        if not isinstance(made, LRScheduler):
            raise ConfigError(f"{scheduler!r} returned {type(made).__name__}, not a scheduler.")
        self.scheduler_interval = choose_interval(made, kwargs, self.scheduler_interval)
        self.scheduler = made
        if self.scheduler_interval == "step":  # follows the optimizer, whoever steps it
            self.optimizer.register_step_post_hook(lambda *_: self._step_scheduler())

    def _step_scheduler(self) -> None:
        if self.scheduler is None:
            return
        try:
            self.scheduler.step()
        except ValueError as error:  # a schedule that is over
            raise ConfigError(f"{type(self.scheduler).__name__} fails: {error}") from error

    def begin(self, epoch_nb: int, batch_nb: int) -> Sequence[str]:
        """Check and describe the schedule, and find the state; see `Optimization.begin`.

        Raises:
            ConfigError: If the schedule ends before the training.
            CheckpointError: If an attribute is state that cannot be saved.
        """
        self._total = epoch_nb, batch_nb
        self._attributes = self._find_attributes()
        self._attributes.begin()
        self._check_saved(self._attributes)
        lines = []
        if self._learned_by_loss:
            count = sum(parameter.numel() for parameter in self._learned_by_loss.values())
            lines.append(f"loss: {count:,} parameters, trained with the network's")
        if self.scheduler is not None:
            self._check_schedule()
            lines.append(self._length.describe(self.scheduler))
        return lines

    def _check_schedule(self) -> None:
        if self.scheduler is not None:
            self._length.check(self.scheduler)

    @property
    def _length(self) -> TrainingLength:
        by_step = self.scheduler_interval == "step"
        return TrainingLength(*self._total, self._accumulate if by_step else None)

    def compute_loss(self, batch: PredictedBatch) -> torch.Tensor:
        """Return the mean of the prediction fields' losses, of normalized values if configured.

        Raises:
            UsageError: If the loss or optimizer has not been chosen yet.
            ConfigError: If there are more predictions than targets, or fewer.
            FieldsMismatchError: If the shapes of a prediction and its target differ.
        """
        if self.loss is None or self._network is None:
            raise UsageError("compute_loss() must be called after set_loss() and set_optimizer().")
        losses = []
        for pred_name, opt_name in _pairs(self._network):
            pred, target = batch.prediction[pred_name], batch.targets[opt_name]
            # Targets that are class indices, which are integers, have other shapes.
            if pred.shape != target.shape and target.is_floating_point():
                text = f'shape {tuple(pred.shape)}, but "{opt_name}" has {tuple(target.shape)}'
                raise FieldsMismatchError("Prediction and target differ", {pred_name: text})
            losses.append(self.loss(pred, _as_target(target, pred, self.loss)))
        return losses[0] if len(losses) == 1 else torch.stack(losses).mean()

    def compute_row_losses(self, batch: PredictedBatch) -> torch.Tensor:
        """Return the loss of each row.

        Losses of PyTorch with a ``reduction`` are computed for all rows at once, others row by row.

        Raises:
            UsageError: If the loss or optimizer has not been chosen yet.
        """
        if self.loss is None or self._network is None:
            raise UsageError("compute_row_losses() needs set_loss() and set_optimizer() first.")
        by_row = _without_reduction(self.loss)
        if by_row is None or type(self).compute_loss is not TorchOptimization.compute_loss:
            rows = range(len(next(iter(batch.prediction.values()))))
            # With gradients, which the loss of a subclass may need.
            return torch.stack([self.compute_loss(batch[row : row + 1]).detach() for row in rows])
        with torch.no_grad():
            losses = []
            for pred_name, opt_name in _pairs(self._network):
                pred, target = batch.prediction[pred_name], batch.targets[opt_name]
                losses.append(by_row(pred, _as_target(target, pred, self.loss)))
            flat = [loss.reshape(len(loss), -1).mean(1) for loss in losses]
            return torch.stack(flat).mean(0)

    def transform_loss(self, loss: torch.Tensor, batch: PredictedBatch) -> dict[str, Any]:
        """Return ``{"loss": <number>}``, for a loss with the reduction "sum" per sample.

        Losses are thus comparable, whatever the sizes of the batches.
        """
        number = self._known[1]
        if loss is not self._known[0]:  # on a GPU, reading it again would wait for the step
            number = loss.item()
        self._known = (None, 0.0)
        return {"loss": number / len(next(iter(batch.data.values()))) if self._sums else number}

    def optimize(self, loss: torch.Tensor) -> None:
        """Update the parameters along the gradient of the loss, or of the mean of several batches.

        With `stops_at_nan`, the loss of each batch and the gradients of each step are checked
        before the step, which costs one norm of all gradients. Gradients that overflow in float16
        are left to the scaler, which skips the step.

        Raises:
            UsageError: If there is no optimizer yet.
            ConfigError: If the loss is not a single number.
            DivergedError: If the loss or a gradient is not finite; the parameters stay unchanged.
        """
        optimizer, network = self._prepared("optimize")
        if loss.numel() != 1:
            raise ConfigError(
                f"The loss has shape {tuple(loss.shape)} but must be a single number: use one that "
                'reduces, for example with loss_kwargs={"reduction": "mean"}.'
            )
        if self._accumulated == 0:
            _clear_gradients(optimizer)
        scaled = loss / self._accumulate if self._accumulate > 1 else loss
        if self._scaler is not None:
            scaled = self._scaler.scale(scaled)
        scaled.backward()
        if self._shared is not None:
            average_gradients(self._shared)
        self._accumulated += 1
        is_due = self._accumulated >= self._accumulate
        norms: Sequence[torch.Tensor] = ()
        if is_due:
            self._accumulated = 0
            norms = self._limit_gradients(optimizer, network)
        if self.stops_at_nan:
            self._check_finite(loss, norms, network)
        if is_due:
            self._step(optimizer)

    def _limit_gradients(
        self, optimizer: torch.optim.Optimizer, network: TorchNetwork
    ) -> Sequence[torch.Tensor]:
        """Scale down large gradients, and return norms that are finite if all gradients are."""
        if self._gradient_clip is not None:
            if self._scaler is not None:
                self._scaler.unscale_(optimizer)
            learned = [*network.parameters(), *self._learned_by_loss.values()]
            norm = torch.nn.utils.clip_grad_norm_(learned, self._gradient_clip)
            return [norm] if self._scaler is None else ()
        if self._scaler is not None or not self.stops_at_nan:
            return ()
        gradients = [
            parameter.grad._values() if parameter.grad.is_sparse else parameter.grad
            for group in optimizer.param_groups
            for parameter in group["params"]
            if parameter.grad is not None
        ]
        return torch._foreach_norm(gradients) if gradients else ()

    def _check_finite(
        self, loss: torch.Tensor, norms: Sequence[torch.Tensor], network: TorchNetwork
    ) -> None:
        """Raise an error if the loss or gradients are not finite.

        In a group of processes, only the gradients are checked, which all processes have in common.
        """
        is_alone = self._shared is None
        values = [loss.detach(), *norms] if is_alone else [*norms]
        if loss.is_cuda and values:  # waits for the GPU once
            alike = [value.to(loss.device, torch.float32) for value in values]
            numbers = torch.stack(alike).tolist()
        else:
            numbers = [value.item() for value in values]
        if is_alone:
            self._known = loss, numbers[0]
        if all(map(math.isfinite, numbers)):
            return
        is_loss = is_alone and not math.isfinite(numbers[0])
        what = f"the loss is {numbers[0]}" if is_loss else ""
        for name, gradient in {**network.get_gradients(), **self._gradients_of_loss()}.items():
            if what:
                break
            if not torch.isfinite(gradient).all():
                what = f'the gradient of the parameter "{name}" contains NaN or infinity'
        if what:  # otherwise, only the norm was too large for its type
            self._accumulated, self._known = 0, (None, 0.0)
            raise DivergedError(what)

    def _prepared(self, method: str) -> tuple[torch.optim.Optimizer, TorchNetwork]:
        if self.optimizer is None or self._network is None:
            raise UsageError(f"{method}() must be called after set_optimizer().")
        return self.optimizer, self._network

    def _step(self, optimizer: torch.optim.Optimizer) -> None:
        """Update the parameters along their gradients."""
        if self._scaler is None:
            optimizer.step()
        else:
            self._scaler.step(optimizer)
            self._scaler.update()

    def join(self, group: Group) -> None:
        """Average the gradients of all processes from now on; see `Optimization.join`.

        Raises:
            UsageError: If there is no optimizer yet.
        """
        _, network = self._prepared("join")
        loss, self._shared = self.loss, None
        if group.size > 1:
            self._shared = network
            if isinstance(loss, torch.nn.Module) and loss.state_dict():
                self._shared = torch.nn.ModuleList([network, loss])
            broadcast_parameters(self._shared)

    def __str__(self) -> str:
        scheduler = type(self.scheduler).__name__ if self.scheduler is not None else "no scheduler"
        return f"{self.loss}, {scheduler}\n{self.optimizer}"

    def learning_rate(self) -> float | None:
        """Return the learning rate of the optimizer's first group of parameters."""
        if self.optimizer is None:
            return None
        return float(self.optimizer.param_groups[0]["lr"])

    def schedule(self, loss: float) -> None:
        """Step a scheduler that counts epochs; see `Optimization.schedule`.

        Raises:
            DivergedError: If gradients stayed infinite in float16, regardless of their scaling.
        """
        if self.stops_at_nan and self._scaler and self._scaler.get_scale() < _LEAST_SCALE:
            raise DivergedError(
                "the gradients are not finite in float16, regardless of their scaling; "
                'mixed_precision="bfloat16" has a wider range'
            )
        if isinstance(self.scheduler, ReduceLROnPlateau):
            if not math.isnan(loss):
                self.scheduler.step(loss)
        elif self.scheduler_interval != "step":
            self._step_scheduler()

    def save_state(self, path: Path) -> None:
        """Write the state of the optimizer, scheduler, unfinished step and torch's random numbers.

        Further state is found in the attributes of the optimization and of its loss, as described
        for the class.

        Raises:
            UsageError: If there is no optimizer yet.
            CheckpointError: If a part of the state cannot be saved.
        """
        optimizer, network = self._prepared("save_state")
        attributes = self._attributes or self._find_attributes()
        state: dict[str, Any] = {
            "kinds": self._kinds(),
            "optimizer": optimizer.state_dict(),
            "random": random_state(network.device),
            "attributes": attributes.save(),
        }
        if not self._has_saved:
            self._check_saved(attributes)
        elif lost := self._unsavable(attributes):
            state["lost"] = lost  # the parameters are worth saving nevertheless
        for name, item in (("scheduler", self.scheduler), ("scaler", self._scaler)):
            if item is not None:
                state[name] = item.state_dict()
        if self.scheduler is not None:
            state["interval"] = self.scheduler_interval
        if self._accumulated:
            state["accumulated"] = self._accumulated
            state["gradients"] = network.get_gradients()
            state["gradients of the loss"] = self._gradients_of_loss()
        write_state(path, state)
        self._has_saved = True

    def load_state(self, path: Path) -> None:
        """Restore the state written by `save_state`, including torch's random numbers.

        Raises:
            UsageError: If there is no optimizer yet.
            CheckpointError: If the file is missing, damaged, or for another optimizer or scheduler,
                or lacks some of the state.
        """
        optimizer, network = self._prepared("load_state")
        state = read_state(path)
        self._check_fits(path, state)
        try:
            optimizer.load_state_dict(state["optimizer"])
            self._accumulated = state.get("accumulated", 0)
            network.set_gradients(state.get("gradients", {}))
        except (KeyError, ValueError) as error:
            raise CheckpointError(f"{path} is from another network: {error}.") from error
        for name, parameter in self._learned_by_loss.items():
            gradient = state.get("gradients of the loss", {}).get(name)
            parameter.grad = None if gradient is None else gradient.to(parameter)
        for name, item in (("scheduler", self.scheduler), ("scaler", self._scaler)):
            if item is not None:
                item.load_state_dict(state[name])
        try:
            attributes = self._attributes or self._find_attributes()
            attributes.load(state.get("attributes", {}), network.device)
        except CheckpointError as error:
            raise CheckpointError(f"{path} does not fit: {error}. {_ANOTHER}") from error
        set_random_state(state["random"], network.device)
        self._check_schedule()

    def _check_fits(self, path: Path, state: Mapping[str, Any]) -> None:
        if state.get("kinds") != self._kinds():
            found, own = (" and ".join(kinds) for kinds in (state.get("kinds", []), self._kinds()))
            raise CheckpointError(f"{path} is the state of {found or 'nothing'}, not of {own}.")
        former = state.get("interval", "epoch")
        if self.scheduler is not None and former != self.scheduler_interval:
            raise CheckpointError(
                f"The scheduler of {path} was stepped every {former}, not every "
                f'{self.scheduler_interval}: set NetworkConfig.scheduler_interval="{former}" '
                f"(--network.scheduler-interval {former}) to continue."
            )
        if lost := state.get("lost"):
            raise CheckpointError(
                f"{path} lacks a part of the state: {_reasons(lost)}. A resumed training would "
                f"differ. {_ANOTHER}"
            )

    def _find_attributes(self) -> Attributes:
        network = self._network
        modules = () if network is None else network.modules()
        tensors = () if network is None else (*network.parameters(), *network.buffers())
        used = (self.optimizer, self.scheduler, self._scaler)
        return Attributes(
            self,
            skipped=_own_attributes(),
            extra=("loss",),
            unsaved=self.unsaved,
            known=[*modules, *tensors, *(item for item in used if item is not None)],
        )

    def _unsavable(self, attributes: Attributes) -> dict[str, str]:
        """Return what cannot be saved, and why, unless a subclass saves the state itself."""
        own = type(self).save_state is not TorchOptimization.save_state
        return {} if own else attributes.unsavable

    def _check_saved(self, attributes: Attributes) -> None:
        if not (lost := self._unsavable(attributes)):
            return
        kind, first = type(self).__name__, next(iter(lost))
        raise CheckpointError(
            f"The state of {kind} cannot be saved, so that a resumed training would differ: "
            f"{_reasons(lost)}. Make it an attribute of its own that is a tensor, a "
            "torch.nn.Module, an object with state_dict() and load_state_dict(), or a list or "
            "dictionary of these; or override save_state() and load_state(); or, if it is no "
            f'state, name it in the class: unsaved = ("{first}",).'
        )

    def _gradients_of_loss(self) -> dict[str, torch.Tensor]:
        named = self._learned_by_loss.items()
        return {name: p.grad for name, p in named if p.grad is not None}

    def _kinds(self) -> list[str]:
        used = (self.optimizer, self.scheduler, self._scaler)
        return [type(item).__name__ for item in used if item is not None]


def _reasons(lost: Mapping[str, str]) -> str:
    return "; ".join(f'"{path}" {reason}' for path, reason in lost.items())


@functools.cache
def _own_attributes() -> frozenset[str]:
    """Return the attributes of TorchOptimization, which it saves itself."""
    return frozenset(vars(TorchOptimization())) | set(inspect.get_annotations(Optimization))
