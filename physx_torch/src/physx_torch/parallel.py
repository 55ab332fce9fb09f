"""Data-parallel training: several processes of torch.distributed train one network.

``torchrun`` starts the processes. Each computes the gradients of its share of a batch; their mean
is taken before they are clipped and the optimizer steps, so the parameters stay the same in all.
"""

from __future__ import annotations

import atexit
import json
import os
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import distributed

from physx_core.components import Group
from physx_core.errors import ConfigError
from physx_torch.devices import find_device


def join_group(device: str) -> Group:
    """Return the group that this process belongs to; of one process unless torchrun started it.

    The processes talk through NCCL where each has a CUDA device of its own, otherwise through Gloo.

    Args:
        device: Where the network will compute, as in `NetworkConfig.device`.

    Raises:
        ConfigError: The installed torch cannot do it, or the processes do not find each other.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return Group()
    if not distributed.is_available():
        raise ConfigError("The installed torch has no torch.distributed: leave torchrun out.")
    return TorchGroup(find_device(device))


class TorchGroup(Group):
    """The processes that torchrun started."""

    def __init__(self, device: torch.device) -> None:
        """Meet the other processes, unless the user's own code has done that already.

        Raises:
            ConfigError: They do not find each other.
        """
        if not distributed.is_initialized():
            _meet(device)
        self.rank, self.size = distributed.get_rank(), distributed.get_world_size()
        is_cuda_only = distributed.get_backend() == "nccl"  # a group that the user's code made
        self._device = device if is_cuda_only else torch.device("cpu")

    def tell(self, value: Any) -> Any:
        """Return what the leading process gave."""
        text = json.dumps(value).encode() if self.leads else b""
        length = self._led(torch.tensor([len(text)]))
        told = torch.zeros(int(length.item()), dtype=torch.uint8)
        if self.leads:
            told = torch.frombuffer(bytearray(text), dtype=torch.uint8)
        return json.loads(self._led(told).cpu().numpy().tobytes())

    def _led(self, tensor: torch.Tensor) -> torch.Tensor:
        tensor = tensor.to(self._device)
        distributed.broadcast(tensor, 0)
        return tensor

    def total(self, values: Sequence[float]) -> list[float]:
        """Return the sums of the numbers over all processes."""
        sums = torch.tensor(values, dtype=torch.float64, device=self._device)
        distributed.all_reduce(sums)
        return [float(value) for value in sums.tolist()]


def _meet(device: torch.device) -> None:
    """Meet the other processes, once: they stay together until they end.

    Raises:
        ConfigError: They do not find each other.
    """
    own = device.type == "cuda" and _local("WORLD_SIZE") <= torch.cuda.device_count()
    if own:
        torch.cuda.set_device(device)
    try:
        distributed.init_process_group("cpu:gloo,cuda:nccl" if own else "gloo")
    except (RuntimeError, ValueError) as error:
        raise ConfigError(
            f"The processes that train together do not find each other: {error}. "
            "Start them with: torchrun --nproc-per-node N -m physx_core.cli train ..."
        ) from error
    atexit.register(_part)


def _part() -> None:
    if distributed.is_initialized():
        distributed.destroy_process_group()


def take_first_values(network: torch.nn.Module) -> None:
    """Give parameters and buffers the values that they have in the leading process."""
    with torch.no_grad():
        for tensors in _alike([*network.parameters(), *network.buffers()]):
            flat = _flat(tensors)
            distributed.broadcast(flat, 0)
            _put(flat, tensors)


def average_gradients(network: torch.nn.Module) -> None:
    """Replace each gradient by its mean over all processes, and buffers by the leading process's.

    A parameter that no process has a gradient of keeps none; where some have one, it counts as zero
    in the others.
    """
    parameters = [parameter for parameter in network.parameters() if parameter.requires_grad]
    size = distributed.get_world_size()
    for alike in _alike(parameters):
        has = torch.tensor([p.grad is not None for p in alike], device=alike[0].device)
        parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in alike]
        flat = torch.cat([_flat(parts), has.to(_real(parts[0]).dtype)])
        distributed.all_reduce(flat)
        flat, known = flat[: -len(alike)] / size, flat[-len(alike) :].tolist()
        _put(flat, parts)
        for parameter, part, count in zip(alike, parts, known, strict=True):
            parameter.grad = part if count else None
    buffers = list(network.buffers())
    if buffers:
        for alike in _alike(buffers):
            flat = _flat(alike)
            distributed.broadcast(flat, 0)
            _put(flat, alike)


def _alike(tensors: Iterable[torch.Tensor]) -> list[list[torch.Tensor]]:
    """Return the tensors in groups of one type and device."""
    groups: dict[tuple[torch.dtype, torch.device], list[torch.Tensor]] = {}
    for tensor in tensors:
        groups.setdefault((tensor.dtype, tensor.device), []).append(tensor)
    return list(groups.values())


def _real(tensor: torch.Tensor) -> torch.Tensor:
    """Return a view as real numbers: not every way of talking takes complex ones."""
    return torch.view_as_real(tensor) if tensor.is_complex() else tensor


def _flat(tensors: Sequence[torch.Tensor]) -> torch.Tensor:
    return torch.cat([_real(tensor.detach()).reshape(-1) for tensor in tensors])


def _put(flat: torch.Tensor, tensors: Sequence[torch.Tensor]) -> None:
    """Write a flat tensor's values back into the tensors that it was made of."""
    start = 0
    for tensor in tensors:
        real = _real(tensor.detach())
        real.copy_(flat[start : start + real.numel()].view_as(real))
        start += real.numel()


def _local(name: str) -> int:
    return int(os.environ.get(f"LOCAL_{name}", "1"))
