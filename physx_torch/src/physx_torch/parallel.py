"""Data-parallel training: several processes of torch.distributed train one network.

``torchrun`` starts the processes. Each computes the gradients of its share of a batch; they are
averaged before clipping and stepping, so all processes have the same parameters.
"""

from __future__ import annotations

import atexit
import datetime
import os
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import distributed

from physx_core.components import Group
from physx_core.errors import ConfigError
from physx_core.net import decode, encode
from physx_core.typing import Batch
from physx_torch.devices import find_device

_TIMEOUT = datetime.timedelta(days=1)
"""Longest time that the others wait for one, whose environments may take long for a batch."""


def join_group(device: str) -> Group:
    """Return the group of this process, which is its only member unless torchrun started it.

    The processes communicate by NCCL if each has its own CUDA device, otherwise by Gloo.

    Args:
        device: The network's device, as in `NetworkConfig.device`.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return Group()
    if not distributed.is_available():
        raise ConfigError("The installed torch has no torch.distributed: omit torchrun.")
    return TorchGroup(find_device(device))


class TorchGroup(Group):
    """The processes that torchrun started."""

    def __init__(self, device: torch.device) -> None:
        """Connect to the other processes, unless the user's code has already done so."""
        if not distributed.is_initialized():
            _connect(device)
        self.rank, self.size = distributed.get_rank(), distributed.get_world_size()
        is_cuda_only = distributed.get_backend() == "nccl"  # a group that the user's code created
        self._device = device if is_cuda_only else torch.device("cpu")

    def broadcast(self, value: Any) -> Any:
        """Return the leading process's value in all processes."""
        content = encode(value) if self.is_main else b""
        length = self._broadcast(torch.tensor([len(content)]))
        told = torch.zeros(int(length.item()), dtype=torch.uint8)
        if self.is_main:
            told = torch.frombuffer(bytearray(content), dtype=torch.uint8)
        return decode(self._broadcast(told).cpu().numpy().tobytes())

    def _broadcast(self, tensor: torch.Tensor) -> torch.Tensor:
        tensor = tensor.to(self._device)
        distributed.broadcast(tensor, 0)
        return tensor

    def scatter(self, batch: Batch) -> tuple[Batch, float]:
        """Return this process's share of the leading process's batch, and its weight."""
        kinds = {name: (array.dtype.str, array.shape[1:]) for name, array in batch.items()}
        shares = [self.share_for(rank, batch) for rank in range(self.size if self.is_main else 0)]
        rows = [len(next(iter(share.values()))) for share, _ in shares]
        told = self.broadcast([kinds, rows, [weight for _, weight in shares]])
        kinds, count, weight = told[0], told[1][self.rank], told[2][self.rank]
        if self.is_main:
            for rank in range(1, self.size):
                distributed.send(self._packed(shares[rank][0]), rank)
            return shares[0]
        types = {name: np.dtype((kind, tuple(shape))) for name, (kind, shape) in kinds.items()}
        nbytes = count * sum(dtype.itemsize for dtype in types.values())
        received = torch.empty(nbytes, dtype=torch.uint8, device=self._device)
        distributed.recv(received, 0)
        content, place, share = received.cpu().numpy(), 0, {}
        for name, dtype in types.items():
            part = content[place : place + count * dtype.itemsize]
            share[name] = np.frombuffer(part.tobytes(), dtype.base).reshape(count, *dtype.shape)
            place += part.nbytes
        return share, weight

    def _packed(self, share: Batch) -> torch.Tensor:
        content = b"".join(np.ascontiguousarray(array).tobytes() for array in share.values())
        return torch.frombuffer(bytearray(content), dtype=torch.uint8).to(self._device)

    def total(self, values: Sequence[float]) -> list[float]:
        """Return the sums of the numbers over all processes."""
        sums = torch.tensor(values, dtype=torch.float64, device=self._device)
        distributed.all_reduce(sums)
        return [float(value) for value in sums.tolist()]


def _connect(device: torch.device) -> None:
    """Connect to the other processes until this one exits."""
    own = device.type == "cuda" and _local("WORLD_SIZE") <= torch.cuda.device_count()
    if own:
        torch.cuda.set_device(device)
    try:
        distributed.init_process_group("cpu:gloo,cuda:nccl" if own else "gloo", timeout=_TIMEOUT)
    except (RuntimeError, ValueError) as error:
        raise ConfigError(
            f"The processes that train together cannot connect: {error}. "
            "Start them with: torchrun --nproc-per-node N -m physx_core.cli train ..."
        ) from error
    atexit.register(_disconnect)


def _disconnect() -> None:
    if distributed.is_initialized():
        distributed.destroy_process_group()


def broadcast_parameters(network: torch.nn.Module) -> None:
    """Set parameters and buffers to their values in the leading process."""
    with torch.no_grad():
        for tensors in _group_alike([*network.parameters(), *network.buffers()]):
            flat = _flatten(tensors)
            distributed.broadcast(flat, 0)
            _unflatten(flat, tensors)


def average_gradients(network: torch.nn.Module) -> None:
    """Replace each gradient by its mean over all processes, and buffers by the leading process's.

    A parameter without a gradient in all processes keeps none; if only some have a gradient, the
    others count as zero.
    """
    parameters = [parameter for parameter in network.parameters() if parameter.requires_grad]
    size = distributed.get_world_size()
    for alike in _group_alike(parameters):
        has = torch.tensor([p.grad is not None for p in alike], device=alike[0].device)
        parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in alike]
        flat = torch.cat([_flatten(parts), has.to(_real(parts[0]).dtype)])
        distributed.all_reduce(flat)
        flat, known = flat[: -len(alike)] / size, flat[-len(alike) :].tolist()
        _unflatten(flat, parts)
        for parameter, part, count in zip(alike, parts, known, strict=True):
            parameter.grad = part if count else None
    buffers = list(network.buffers())
    if buffers:
        for alike in _group_alike(buffers):
            flat = _flatten(alike)
            distributed.broadcast(flat, 0)
            _unflatten(flat, alike)


def _group_alike(tensors: Iterable[torch.Tensor]) -> list[list[torch.Tensor]]:
    """Return the tensors in groups of equal type and device."""
    groups: dict[tuple[torch.dtype, torch.device], list[torch.Tensor]] = {}
    for tensor in tensors:
        groups.setdefault((tensor.dtype, tensor.device), []).append(tensor)
    return list(groups.values())


def _real(tensor: torch.Tensor) -> torch.Tensor:
    """Return a view as real numbers, because not every backend supports complex numbers."""
    return torch.view_as_real(tensor) if tensor.is_complex() else tensor


def _flatten(tensors: Sequence[torch.Tensor]) -> torch.Tensor:
    return torch.cat([_real(tensor.detach()).reshape(-1) for tensor in tensors])


def _unflatten(flat: torch.Tensor, tensors: Sequence[torch.Tensor]) -> None:
    """Copy a flat tensor's values into the tensors that it was concatenated from."""
    start = 0
    for tensor in tensors:
        real = _real(tensor.detach())
        real.copy_(flat[start : start + real.numel()].view_as(real))
        start += real.numel()


def _local(name: str) -> int:
    return int(os.environ.get(f"LOCAL_{name}", "1"))
