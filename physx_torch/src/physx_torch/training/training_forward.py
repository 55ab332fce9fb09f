"""Compiles a network's forward function for training, or runs it in mixed precision."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

from physx_core.errors import ConfigError, listed

Forward = Callable[..., Any]

PRECISIONS = {"bfloat16": torch.bfloat16, "float16": torch.float16}
"""Types of mixed precision by name."""


def compile_forward(forward: Forward, backend: str) -> Forward:
    """Return a function compiled by ``torch.compile`` on its first call.

    Args:
        forward: The function.
        backend: Name of a ``torch.compile`` backend, for example ``"inductor"``.
    """
    known = torch.compiler.list_backends(exclude_tags=())
    if backend not in known:
        raise ConfigError(f'torch.compile has no backend "{backend}". It has: {listed(known)}.')
    made = torch.compile(forward, backend=backend)

    def run(*inputs: Any) -> Any:
        from torch._dynamo.exc import TorchDynamoException

        try:
            return made(*inputs)
        except TorchDynamoException as error:
            reason = " ".join(str(error).strip().splitlines()[:2])
            raise ConfigError(
                f'torch.compile with the backend "{backend}" does not work here: {reason}. '
                'Omit "compile", or install the compiler that it needs: for the CPU, g++.'
            ) from error

    return run


def run_in_precision(
    forward: Forward, device: torch.device, precision: torch.dtype, back: torch.dtype
) -> Forward:
    """Return a function that computes in mixed precision and returns floating tensors as `back`.

    Args:
        forward: The function.
        device: Device of the network.
        precision: Floating-point type of operations that do not need more digits.
        back: Floating-point type of the network, in which the loss is computed.
    """

    def run(*inputs: Any) -> Any:
        with torch.autocast(device.type, precision):
            output = forward(*inputs)
        return _as_type(output, back)

    return run


def _as_type(output: Any, data_type: torch.dtype) -> Any:
    if isinstance(output, torch.Tensor):
        return output.to(data_type) if output.is_floating_point() else output
    if isinstance(output, Mapping):
        return {name: _as_type(value, data_type) for name, value in output.items()}
    if isinstance(output, (tuple, list)):
        return [_as_type(value, data_type) for value in output]
    return output
