"""State files: nested plain data and tensors as safetensors, which contain no code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from physx_core.errors import CheckpointError
from physx_core.parsing import parse_json
from physx_torch.storage.parameters import read_tensors, write_tensors

_KEY = "state"


def write_state(path: Path, state: Mapping[str, Any]) -> None:
    """Write nested dictionaries, lists, numbers, strings and tensors."""
    tensors: dict[str, torch.Tensor] = {}
    plain = _split(state, "", tensors)
    write_tensors(path, tensors, {_KEY: json.dumps(plain)})


def read_state(path: Path) -> dict[str, Any]:
    """Return the state written by `write_state`, with tuples as lists."""
    tensors, texts = read_tensors(path)
    try:
        state: dict[str, Any] = _join(parse_json(texts[_KEY]), tensors)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} does not contain the state of an optimization.") from error
    return state


def random_state(device: torch.device) -> dict[str, torch.Tensor]:
    """Return the states of torch's random numbers on a device and on the CPU."""
    state = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def set_random_state(state: Mapping[str, torch.Tensor], device: torch.device) -> None:
    """Restore the states of torch's random numbers returned by `random_state`."""
    torch.set_rng_state(state["cpu"])
    if device.type == "cuda" and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)


def _split(value: Any, where: str, tensors: dict[str, torch.Tensor]) -> dict[str, Any]:
    if isinstance(value, torch.Tensor):
        while where in tensors:  # keys may contain slashes
            where += "+"
        tensors[where] = value
        return {"tensor": where}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Mapping):
        items = [[key, _split(item, f"{where}/{key}", tensors)] for key, item in value.items()]
        return {"items": items}
    if isinstance(value, (list, tuple)):
        return {"list": [_split(item, f"{where}/{i}", tensors) for i, item in enumerate(value)]}
    if value is None or isinstance(value, (bool, int, float, str)):
        return {"value": value}
    raise CheckpointError(
        f'"{where}" in the optimization\'s state is a {type(value).__name__}, which cannot be '
        "stored without code."
    )


def _join(plain: dict[str, Any], tensors: Mapping[str, torch.Tensor]) -> Any:
    if "tensor" in plain:
        return tensors[plain["tensor"]]
    if "items" in plain:
        return {key: _join(item, tensors) for key, item in plain["items"]}
    if "list" in plain:
        return [_join(item, tensors) for item in plain["list"]]
    return plain["value"]
