"""Losses of PyTorch: which fields they compare, in which type, and row by row."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, TypeAlias

import torch

from physx_core.errors import ConfigError, listed
from physx_torch.networks.network import TorchNetwork

Loss: TypeAlias = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


def compared_fields(network: TorchNetwork) -> list[tuple[str, str]]:
    """Return the names of each prediction and of the target that it is compared with."""
    predicted, targets = network.pred_fields, network.opt_fields
    if len(predicted) != len(targets):
        raise ConfigError(
            f"{type(network).__name__} predicts {listed(predicted)} but is compared with "
            f"{listed(targets)}: each of pred_fields needs one of opt_fields. For a loss of all of "
            "them together, derive from TorchOptimization and implement compute_loss(batch)."
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
