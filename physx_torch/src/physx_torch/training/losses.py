"""Losses of PyTorch: their terms, which fields they compare, in which type, and row by row."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import torch

from physx_core.errors import ConfigError, listed, nearest
from physx_torch.choices import choose, find_classes, make
from physx_torch.networks.network import TorchNetwork

Loss: TypeAlias = Callable[..., torch.Tensor]
"""Returns a number for a prediction and its target, or for a `PredictedBatch`."""


class LossTable(torch.nn.Module):
    """Several losses by name: of a target, or of a whole batch.

    Attributes:
        losses: The losses by name.
    """

    def __init__(self, losses: Mapping[str, Loss]) -> None:
        """Own those losses that are modules."""
        super().__init__()
        self.losses = dict(losses)
        own = {id(loss): loss for loss in losses.values() if isinstance(loss, torch.nn.Module)}
        self._own = torch.nn.ModuleList(own.values())

    def __repr__(self) -> str:
        return ", ".join(f"{name}: {loss}" for name, loss in self.losses.items())


class Term(NamedTuple):
    """A part of a loss.

    Attributes:
        name: Name of the target, or of a loss of the whole batch; "" if that is the only one.
        loss: The loss.
        weight: Its weight in the mean of all terms.
        pair: The prediction and the target that it compares; None: it gets the whole batch.
    """

    name: str
    loss: Loss
    weight: float = 1.0
    pair: tuple[str, str] | None = None


def make_loss(given: Any, arguments: Mapping[str, Any]) -> Loss:
    """Return the loss that an option names: see `TorchOptimization.set_loss`.

    Args:
        given: The option.
        arguments: Keyword arguments of the loss, if it is a class; of a table, by name.

    Raises:
        ConfigError: If a loss does not exist, or rejects its arguments.
    """
    if isinstance(given, Mapping):
        if unknown := arguments.keys() - given.keys():
            raise ConfigError(
                f"loss_kwargs names {listed(unknown)}, but the losses are {listed(given)}."
            )
        if not given:
            raise ConfigError('The table loss is empty: name a loss, for example {u = "MSELoss"}.')
        return LossTable({n: make_loss(one, arguments.get(n, {})) for n, one in given.items()})
    chosen = choose("loss", given, find_classes(torch.nn.modules.loss, torch.nn.Module))
    if isinstance(chosen, type):
        chosen = make("loss", object, chosen, **arguments)
    elif arguments:
        raise ConfigError(f"loss_kwargs needs a loss that is a class, not {chosen!r}.")
    if not callable(chosen):
        raise ConfigError(f"The loss {given!r} cannot be called with prediction and target.")
    made: Loss = chosen
    return made


def find_terms(loss: Loss, network: TorchNetwork, weights: Mapping[str, float]) -> list[Term]:
    """Return the terms of a loss.

    Args:
        loss: The loss.
        network: The network.
        weights: Weights of terms by name; 1 of others.

    Raises:
        ConfigError: If the loss does not suit the network's targets, or a weight no term.
    """
    if isinstance(loss, LossTable):
        found = _terms_of(loss.losses, network)
    elif takes_batch(loss):
        found = [Term("", loss)]
    else:
        found = [Term(pair[1], loss, pair=pair) for pair in compared_fields(network)]
    names = [term.name for term in found]
    if unknown := [name for name in weights if name not in names]:
        known = listed(names) if any(names) else "a single one without a name"
        raise ConfigError(
            f"loss_weights names {listed(unknown)}, but the terms of the loss are: {known}."
            f"{nearest(unknown[0], names)}"
        )
    return [term._replace(weight=weights.get(term.name, 1.0)) for term in found]


def _terms_of(losses: Mapping[str, Loss], network: TorchNetwork) -> list[Term]:
    whole = [name for name, loss in losses.items() if takes_batch(loss)]
    compared = [name for name in losses if name not in whole]
    pairs = dict(zip(network.opt_fields, network.pred_fields, strict=False))
    for name in compared:
        if name not in pairs:
            raise ConfigError(
                f'The loss "{name}" compares a prediction with a target, but the network has none '
                f"of that name: its targets are {listed(pairs)}.{nearest(name, pairs)} A loss of "
                "all of them takes one argument, the batch."
            )
    if not whole:
        left = [name for name in network.opt_fields if name not in losses]
        if left or len(network.pred_fields) != len(pairs):
            raise ConfigError(
                f"The table loss has none for {listed(left or network.pred_fields)}: name one for "
                f"each target, {listed(network.opt_fields)}, or one that takes the whole batch."
            )
    return [
        Term(name, loss, pair=None if name in whole else (pairs[name], name))
        for name, loss in losses.items()
    ]


def takes_batch(loss: Loss) -> bool:
    """Return whether a loss is called with a `PredictedBatch`: it requires a single argument."""
    called = loss.forward if isinstance(loss, torch.nn.Module) else loss
    try:
        parameters = inspect.signature(called).parameters.values()
    except (TypeError, ValueError):  # some functions written in C have no signature
        return False
    several = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    required = [p for p in parameters if p.default is p.empty and p.kind not in several]
    return len(required) == 1 and not any(p.kind == several[0] for p in parameters)


def check_weights(weights: Any) -> dict[str, float]:
    """Return weights of terms by name.

    Raises:
        ConfigError: If they are none.
    """
    numbers = weights.values() if isinstance(weights, Mapping) else [None]
    right = all(isinstance(w, (int, float)) and 0 <= w < float("inf") for w in numbers)
    if not right or (numbers and not any(numbers)):
        raise ConfigError(
            f"loss_weights is {weights!r} but must be numbers by name, not negative and not all 0, "
            "for example {u = 1.0, p = 0.1}."
        )
    return {name: float(weight) for name, weight in weights.items()}


def compared_fields(network: TorchNetwork) -> list[tuple[str, str]]:
    """Return the names of each prediction and of the target that it is compared with."""
    predicted, targets = network.pred_fields, network.opt_fields
    if len(predicted) != len(targets):
        raise ConfigError(
            f"{type(network).__name__} predicts {listed(predicted)} but is compared with "
            f"{listed(targets)}: each of pred_fields needs one of opt_fields. For a loss of all of "
            "them together, name a function of the batch, loss(batch), or derive from "
            "TorchOptimization and implement compute_loss(batch)."
        )
    return list(zip(predicted, targets, strict=True))


def as_target(target: torch.Tensor, prediction: torch.Tensor, loss: Loss) -> torch.Tensor:
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


def without_reduction(loss: Loss) -> Loss | None:
    """Return a loss that returns each element's own loss; None if that is not known to work."""
    if not isinstance(loss, torch.nn.Module) or getattr(loss, "reduction", "") != "mean":
        return None
    is_own = type(loss).__module__ == "torch.nn.modules.loss"
    if not is_own or getattr(loss, "weight", None) is not None:
        return None
    single: Any = copy.copy(loss)
    single.reduction = "none"
    return single
