"""TorchOptimization: PyTorch's losses, optimizers and learning-rate schedulers."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Mapping, Sequence
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
from physx_torch.networks.averaging import ParameterAverage
from physx_torch.networks.network import TorchNetwork
from physx_torch.parallel import average_gradients, broadcast_parameters
from physx_torch.storage.attributes import Attributes
from physx_torch.training.gradients import GradientCheck, clear, is_finite
from physx_torch.training.losses import (
    Loss,
    LossTable,
    Term,
    as_target,
    check_weights,
    compared_fields,
    find_terms,
    make_loss,
    without_reduction,
)
from physx_torch.training.optimization_state import OptimizationState, describe, gradients_of
from physx_torch.training.schedules import TrainingLength, choose_interval
from physx_torch.training.training_forward import (
    PRECISIONS,
    Forward,
    compile_forward,
    run_in_precision,
)

_LEAST_SCALE = 1e-9


class TorchOptimization(Optimization):
    """Gradient descent with any PyTorch loss, optimizer and scheduler.

    The loss of a network with several prediction fields is the mean of the fields' losses: the i-th
    of `pred_fields` is compared with the i-th of `opt_fields`. A table has a loss for each target,
    and losses of the whole batch, such as the residual of an equation; `set_loss` says how. If a
    subclass returns more than ``loss`` from `transform_loss`, that is recorded too.

    Parameters of the loss are trained with the network's, by the same optimizer.

    A subclass may have further state: `save_state` finds it in the attributes of the optimization
    and of a loss that is a module. It saves optimizers, schedulers, modules such as averaged
    models, and other objects with ``state_dict``, if they are created before the training, for
    example in `set_optimizer`; tensors, arrays and generators of random numbers; lists and
    dictionaries of these; and plain data that have changed since the training began. Anything else
    that is state is an error before or after the first batch.

    With ``average``, validation, checkpoints, predictions and exports use the mean of the
    parameters over the steps; a resumed training goes on with what was learned.

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
        loss_weights: Mapping[str, float] | None = None,
        extra_fields: Sequence[str] | None = None,
        differentiates_inputs: bool | None = None,
        average: float | None = None,
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
            loss_kwargs: Keyword arguments of the loss, if it is a class; of a table, by name.
            loss_weights: Weights of the terms of the loss, by the names of the targets, or of the
                losses in a table; 1 of others. The loss is the weighted mean, so weights change
                what counts more, not how large the steps are.
            extra_fields: Fields of the batch that a loss reads in addition to the network's.
            differentiates_inputs: Whether a loss of the batch differentiates predictions with
                respect to the network's inputs, as the residual of a differential equation does.
            average: Share of the mean of the parameters that is left after each step, for example
                0.999: an exponential mean over about 1000 steps, with which the network is
                validated and predicts. None: no mean.

        Raises:
            ConfigError: If an option is invalid.
        """
        if gradient_clip is not None and not gradient_clip > 0:
            raise ConfigError(f"gradient_clip is {gradient_clip!r} but must be positive.")
        if type(accumulate) is not int or accumulate < 1:
            raise ConfigError(f"accumulate is {accumulate!r} but must be a positive integer.")
        if average is not None and not 0 < average < 1:
            raise ConfigError(f"average is {average!r} but must be between 0 and 1.")
        if mixed_precision not in (None, *PRECISIONS):
            raise ConfigError(
                f"mixed_precision is {mixed_precision!r} but must be {listed(PRECISIONS)} or None."
            )
        self.loss: Loss | None = None
        self.optimizer: torch.optim.Optimizer | None = None
        self.scheduler: LRScheduler | None = None
        self._gradient_clip = gradient_clip
        self._accumulate, self._accumulated = accumulate, 0
        self._decay = average
        self._precision = PRECISIONS[mixed_precision] if mixed_precision else None
        self._backend = "inductor" if compile is True else compile
        self._loss_kwargs = dict(loss_kwargs or {})
        self._loss_weights = check_weights(loss_weights or {})
        if extra_fields is not None:
            self.extra_fields = tuple(extra_fields)
        if differentiates_inputs is not None:
            self.differentiates_inputs = differentiates_inputs
        self._network: TorchNetwork | None = None
        self._scaler: torch.amp.GradScaler | None = None
        self._sums = False
        self._learned_by_loss: dict[str, torch.nn.Parameter] = {}
        self._shared: torch.nn.Module | None = None  # what all processes have in common
        self._total = (0, 0)  # epochs of the training, batches in each
        self._attributes: Attributes | None = None
        self._has_saved = False
        self._terms: list[Term] | None = None
        self._is_plain = True  # nothing but the mean of targets' losses
        self._losses: dict[str, torch.Tensor] = {}  # of the terms, of the last batch
        self._check = GradientCheck()
        self._known: tuple[torch.Tensor | None, float] = (None, 0.0)  # the loss that was last read

    def set_loss(self, loss: str | Loss | Mapping[str, Any] | None) -> None:
        """Choose the loss function.

        Args:
            loss: Name of a class in `torch.nn` such as ``"MSELoss"``; ``"package.module:Name"``; a
                class; a module; a function of prediction and target; a function of a
                `PredictedBatch`, as a loss of several predictions and targets together; or a table
                of these, by the name of a target, or any name of a function of the batch.

        Raises:
            ConfigError: If the loss does not exist, rejects `loss_kwargs`, or is None.
        """
        if loss is None:
            raise ConfigError(
                'A training needs a loss, for example loss="MSELoss" (--network.loss MSELoss).'
            )
        chosen = make_loss(loss, self._loss_kwargs)
        self.loss, self._terms = chosen, None
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
        self._terms = None
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
            find_terms(self.loss or torch.nn.MSELoss(), network, self._loss_weights)
        self.optimizer = made
        if self._decay is not None:
            network.average = average = ParameterAverage(network, self._decay)
            made.register_step_post_hook(lambda *_: average.update())
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
        """Return the mean of the terms of the loss, of normalized values if configured.

        Raises:
            UsageError: If the loss or optimizer has not been chosen yet.
            ConfigError: If there are more predictions than targets, or fewer.
            FieldsMismatchError: If the shapes of a prediction and its target differ.
        """
        if self.loss is None or self._network is None:
            raise UsageError("compute_loss() must be called after set_loss() and set_optimizer().")
        if self._terms is None:
            self._terms = find_terms(self.loss, self._network, self._loss_weights)
            self._is_plain = not (isinstance(self.loss, LossTable) or self._loss_weights)
        losses = []
        for name, loss, _, pair in self._terms:  # calls would take as long as a small loss
            if pair is None:
                losses.append(loss(batch))
                continue
            pred, target = batch.prediction[pair[0]], batch.targets[name]
            if not target.is_floating_point():  # class indices, for example, of another shape
                target = as_target(target, pred, loss)
            elif pred.shape != target.shape:
                text = f'shape {tuple(pred.shape)}, but "{name}" has {tuple(target.shape)}'
                raise FieldsMismatchError("Prediction and target differ", {pair[0]: text})
            losses.append(loss(pred, target))
        if self._is_plain:
            return losses[0] if len(losses) == 1 else torch.stack(losses).mean()
        pairs = list(zip(self._terms, losses, strict=True))
        self._losses = {term.name: loss.detach() for term, loss in pairs}
        weighted = torch.stack([term.weight * loss for term, loss in pairs])
        return weighted.sum() / sum(term.weight for term in self._terms)

    def compute_row_losses(self, batch: PredictedBatch) -> torch.Tensor:
        """Return the loss of each row.

        Losses of PyTorch with a ``reduction`` are computed for all rows at once, others row by row.

        Raises:
            UsageError: If the loss or optimizer has not been chosen yet.
        """
        if self.loss is None or self._network is None:
            raise UsageError("compute_row_losses() needs set_loss() and set_optimizer() first.")
        by_row = None if self._loss_weights else without_reduction(self.loss)
        if by_row is None or type(self).compute_loss is not TorchOptimization.compute_loss:
            rows = range(len(next(iter(batch.prediction.values()))))
            # With gradients, which the loss of a subclass may need.
            each = [self.compute_loss(self._row_of(batch, row)).detach() for row in rows]
            return torch.stack(each)
        with torch.no_grad():
            losses = []
            for pred_name, opt_name in compared_fields(self._network):
                pred, target = batch.prediction[pred_name], batch.targets[opt_name]
                losses.append(by_row(pred, as_target(target, pred, self.loss)))
            flat = [loss.reshape(len(loss), -1).mean(1) for loss in losses]
            return torch.stack(flat).mean(0)

    def _row_of(self, batch: PredictedBatch, row: int) -> PredictedBatch:
        one = batch[row : row + 1]
        if not self.differentiates_inputs:
            return one
        data = batch.network.with_gradients(one.data)
        return PredictedBatch.of(batch.network, batch.transformation, data)

    def transform_loss(self, loss: torch.Tensor, batch: PredictedBatch) -> dict[str, Any]:
        """Return ``{"loss": <number>}``, for a loss with the reduction "sum" per sample.

        Losses are thus comparable, whatever the sizes of the batches. Of a table, or with weights,
        each term is ``loss/<name>``.
        """
        number = self._known[1]
        if loss is not self._known[0]:  # on a GPU, reading it again would wait for the step
            number = loss.item()
        self._known = (None, 0.0)
        mean = number / len(next(iter(batch.data.values()))) if self._sums else number
        found: dict[str, Any] = {"loss": mean}
        if self._losses:
            found |= {f"loss/{name}": loss for name, loss in self._losses.items()}
        return found

    def optimize(self, loss: torch.Tensor) -> None:
        """Update the parameters along the gradient of the loss, or of the mean of several batches.

        With `stops_at_nan`, the loss of each batch and the gradients of each step are checked
        before the step, in one pass over the gradients: see `GradientCheck`. Gradients that
        overflow in float16 are left to the scaler, which skips the step.

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
            clear(optimizer)
        scaled = loss / self._accumulate if self._accumulate > 1 else loss
        if self._scaler is not None:
            scaled = self._scaler.scale(scaled)
        scaled.backward()
        if self._shared is not None:
            average_gradients(self._shared)
        self._accumulated += 1
        if is_due := self._accumulated >= self._accumulate:
            self._accumulated = 0
        learned, norm, clip = [], None, self._gradient_clip or 0.0
        if is_due and clip:
            learned = [*network.parameters(), *self._learned_by_loss.values()]
            norm = self._unscaled_norm(optimizer, learned)
        if self.stops_at_nan:
            self._check_finite(loss, norm, optimizer if is_due else None)
        if norm is not None:
            torch.nn.utils.clip_grads_with_norm_(learned, clip, norm)
        if is_due:
            self._step(optimizer)

    def _unscaled_norm(
        self, optimizer: torch.optim.Optimizer, learned: Sequence[torch.nn.Parameter]
    ) -> torch.Tensor:
        """Undo the scaling of the gradients for float16; return the norm of all together."""
        if self._scaler is not None:
            self._scaler.unscale_(optimizer)
        return torch.nn.utils.get_total_norm([p.grad for p in learned if p.grad is not None])

    def _check_finite(
        self,
        loss: torch.Tensor,
        norm: torch.Tensor | None,
        optimizer: torch.optim.Optimizer | None,
    ) -> None:
        """Raise an error if the loss or gradients are not finite.

        In a group of processes, only the gradients are checked, which all processes have in common.

        Args:
            loss: The loss of the batch.
            norm: The norm of all gradients, if it is known.
            optimizer: The optimizer, if it is about to step; None: the gradients are incomplete.
        """
        is_alone = self._shared is None
        values = [loss] if is_alone else []
        if self._scaler is not None:
            optimizer = None
        elif norm is not None:
            values, optimizer = [*values, norm], None
        numbers = self._check.read(values, optimizer)
        if is_alone:
            self._known = loss, numbers[0]
        if not all(map(math.isfinite, numbers)):
            self._find_not_finite(numbers[0] if is_alone else 0.0)

    def _find_not_finite(self, loss: float) -> None:
        """Raise an error that names what is not finite; nothing: only a norm was too large."""
        what = "" if math.isfinite(loss) else f"the loss is {loss}"
        gradients = self.network.get_gradients() | gradients_of(self._learned_by_loss)
        for name, gradient in gradients.items():
            if not what and not is_finite(gradient):
                what = f'the gradient of the parameter "{name}" contains NaN or infinity'
        if what:
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
        state = self._state("save_state")
        found = state.attributes.save()
        if not self._has_saved:
            self._check_saved(state.attributes)
        # Later, the parameters are worth saving nevertheless.
        state.write(path, found, self._accumulated, self._unsavable(state.attributes))
        self._has_saved = True

    def load_state(self, path: Path) -> None:
        """Restore the state written by `save_state`, including torch's random numbers.

        Raises:
            UsageError: If there is no optimizer yet.
            CheckpointError: If the file is missing, damaged, or for another optimizer or scheduler,
                or lacks some of the state.
        """
        self._accumulated = self._state("load_state").read(path)
        self._check_schedule()

    def _state(self, method: str) -> OptimizationState:
        optimizer, network = self._prepared(method)
        return OptimizationState(
            network,
            optimizer,
            self.scheduler,
            self._scaler,
            self.scheduler_interval,
            self._learned_by_loss,
            self._attributes or self._find_attributes(),
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
            unsaved=(*self.unsaved, *(["loss.losses"] if isinstance(self.loss, LossTable) else [])),
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
            f"{describe(lost)}. Make it an attribute of its own that is a tensor, a "
            "torch.nn.Module, an object with state_dict() and load_state_dict(), or a list or "
            "dictionary of these; or override save_state() and load_state(); or, if it is no "
            f'state, name it in the class: unsaved = ("{first}",).'
        )


@functools.cache
def _own_attributes() -> frozenset[str]:
    """Return the attributes of TorchOptimization, which it saves itself."""
    return frozenset(vars(TorchOptimization())) | set(inspect.get_annotations(Optimization))
