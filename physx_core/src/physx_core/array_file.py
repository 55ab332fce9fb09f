"""Array files: arrays by name in the safetensors format, which contains no code."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from physx_core.typing import Array


def pack(arrays: Mapping[str, Array]) -> bytes:
    """Return the content of a file with these arrays."""
    from safetensors.numpy import save

    return save({name: np.asarray(array, order="C") for name, array in arrays.items()})


def unpack(content: bytes) -> dict[str, Array]:
    """Return the arrays in the content of a file.

    Raises:
        ValueError: If it is not in the safetensors format.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        return load(content)
    except (SafetensorError, KeyError, TypeError) as error:
        raise ValueError(f"it is not a file of arrays: {error}") from error
