"""Resolves device names such as "auto" and "cuda:1" on this machine."""

from __future__ import annotations

import os

import torch

from physx_core.errors import ConfigError


def list_devices() -> list[str]:
    """Return the names of the devices that torch can use on this machine."""
    names = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if torch.backends.mps.is_available():
        names.append("mps")
    return names


def find_device(name: str) -> torch.device:
    """Return the device with a name.

    Args:
        name: ``"cpu"``, ``"cuda"``, ``"cuda:<index>"``, ``"mps"`` or ``"auto"``: the first CUDA
            device if there is one, else the CPU. If torchrun started several processes, ``"cuda"``
            and ``"auto"`` give each its own device.
    """
    existing = list_devices()
    own = int(os.environ.get("LOCAL_RANK", "0")) % max(1, torch.cuda.device_count())
    if name == "auto":
        name = f"cuda:{own}" if "cuda:0" in existing else "cpu"
    elif name == "cuda":
        name = f"cuda:{own}"
    if name not in existing:
        raise ConfigError(
            f'There is no device "{name}" on this machine. Devices: {", ".join(existing)}, '
            'or "auto".'
        )
    return torch.device(name)
