"""Parameter files: a module's parameters and buffers as safetensors, which contain no code."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError

from physx_core.errors import CheckpointError


def write_tensors(
    path: Path, tensors: Mapping[str, Any], metadata: dict[str, str] | None = None
) -> None:
    """Write tensors to a safetensors file.

    Args:
        path: The file; an existing one is replaced.
        tensors: Tensors by name. Tensors that share memory are written separately.
        metadata: Further strings to write.
    """
    for name, value in tensors.items():
        if not isinstance(value, torch.Tensor):
            raise CheckpointError(
                f'"{name}" is a {type(value).__name__}; a checkpoint can only contain tensors. '
                "Register it as a buffer of the module, or pass it to the constructor."
            )
    try:
        safetensors.torch.save_file(_separate(tensors), path, metadata)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"Cannot write {path}: {error}.") from _system_error(error)


def _separate(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return contiguous tensors on the CPU, copied only if two of them share memory."""
    separate, places = {}, set()
    for name, value in tensors.items():
        plain = value.detach().resolve_conj().resolve_neg().cpu().contiguous()
        place = plain.untyped_storage().data_ptr()
        separate[name] = plain.clone() if place in places else plain
        places.add(place)
    return separate


def _system_error(error: Exception) -> Exception:
    """Return the system's error, such as a full disk, which the library reports only as text."""
    number = re.search(r"\(os error (\d+)\)", str(error))
    return OSError(int(number[1]), os.strerror(int(number[1]))) if number else error


def read_shapes(path: Path) -> dict[str, torch.Size]:
    """Return the shapes of the tensors in a safetensors file, without reading the tensors."""
    if not path.is_file():
        raise CheckpointError(f"There is no file {path}.")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            return {
                name: torch.Size(file.get_slice(name).get_shape())
                for name in file.keys()  # noqa: SIM118
            }
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is damaged or not a safetensors file: {error}.") from error


def read_tensors(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Return the tensors, on the CPU, and the metadata of a safetensors file."""
    if not path.is_file():
        raise CheckpointError(f"There is no file {path}.")
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            # A copy, because the file may be replaced while its pages are mapped.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
            return tensors, file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is damaged or not a safetensors file: {error}.") from error


def check_match(
    path: Path, name: str, found: Mapping[str, torch.Size], own: Mapping[str, Any]
) -> None:
    """Check that the tensors of a file match a network by name and shape.

    Args:
        path: The file, for error messages.
        name: The network's name, for error messages.
        found: Shapes of the tensors in the file.
        own: The network's tensors.
    """
    lines = [f"{key}: not in the file" for key in own if key not in found]
    lines += [f"{key}: only in the file" for key in found if key not in own]
    lines += [
        f"{key}: {tuple(found[key])} in the file, {tuple(own[key].shape)} in the network"
        for key in own
        if key in found and found[key] != own[key].shape
    ]
    if lines:
        raise CheckpointError(
            f"{path} contains the parameters of a network other than this {name}:\n  "
            + "\n  ".join(lines)
        )
