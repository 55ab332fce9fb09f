"""Gradients of a step: cleared before it, and checked for NaN and infinity after it."""

from __future__ import annotations

from collections.abc import Sequence

import torch

_SMALL = 4096
"""Number of values up to which the gradients of a step are checked together."""


def clear(optimizer: torch.optim.Optimizer) -> None:
    """Remove all gradients, without the hooks of ``optimizer.zero_grad()``.

    The hooks take as long as a small network.
    """
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            parameter.grad = None


def is_finite(gradient: torch.Tensor) -> bool:
    """Return whether a gradient, which may be sparse, contains neither NaN nor infinity."""
    return bool(torch.isfinite(_values(gradient)).all())


class GradientCheck:
    """Finds gradients that are not finite, at little more than the cost of reading them once.

    On the CPU, where each operation costs a microsecond or more, small gradients are checked by one
    call of the operation that PyTorch's GradScaler checks them with, large ones by their sum, which
    is the fastest pass over them. On a GPU the norms of all take one pass, and are read together
    with the loss, as each reading waits for the GPU.
    """

    def __init__(self) -> None:
        self._found = torch.zeros((), device="cpu")
        self._one = torch.ones((), device="cpu")

    def read(
        self, values: Sequence[torch.Tensor], optimizer: torch.optim.Optimizer | None
    ) -> list[float]:
        """Return values as numbers, then numbers that are all finite only if the gradients are.

        A number may be infinite although the gradients are finite: if it is too large for its type.

        Args:
            values: Tensors with one element.
            optimizer: The optimizer whose parameters have the gradients; None: none are checked.
        """
        gradients = []
        for group in optimizer.param_groups if optimizer is not None else ():
            for parameter in group["params"]:
                if parameter.grad is not None:
                    gradients.append(parameter.grad)
        if (first := (values or gradients)[:1]) and first[0].is_cuda:
            return _read_at_once([*values, *_norms(gradients)])
        numbers, small = [], []
        for value in values:
            numbers.append(value.item())
        for gradient in gradients:
            if gradient.numel() <= _SMALL:
                small.append(gradient)
            else:  # of complex numbers, the sum is complex
                numbers.append(abs(gradient.sum().item()))
        return numbers + self._read_small(small) if small else numbers

    def _read_small(self, gradients: list[torch.Tensor]) -> list[float]:
        try:  # multiplies them by 1
            torch._amp_foreach_non_finite_check_and_unscale_(gradients, self._found, self._one)
        except RuntimeError:  # complex or sparse ones, or those on another device
            return [norm.item() for norm in _norms(gradients)]
        if not self._found.item():
            return []
        self._found.zero_()
        return [float("inf")]


def _values(gradient: torch.Tensor) -> torch.Tensor:
    return gradient._values() if gradient.is_sparse else gradient


def _norms(gradients: Sequence[torch.Tensor]) -> Sequence[torch.Tensor]:
    return torch._foreach_norm([_values(gradient) for gradient in gradients]) if gradients else ()


def _read_at_once(values: Sequence[torch.Tensor]) -> list[float]:
    device = next(value.device for value in values if value.is_cuda)
    alike = [value.to(device, torch.float32) for value in values]
    numbers: list[float] = torch.stack(alike).tolist()
    return numbers
