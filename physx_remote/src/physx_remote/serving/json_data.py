"""Conversion of arbitrary values to JSON data."""

from __future__ import annotations

from typing import Any

import numpy as np

_KINDS = "biuf"
_DEEPEST = 32


def to_json_data(value: Any, depth: int = 0) -> Any:
    """Return the part of a value that JSON can represent.

    Arrays become lists. Values that JSON cannot represent are omitted from dictionaries, and become
    None elsewhere. Numbers that are not finite are kept.
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist() if value.dtype.kind in _KINDS else None
    if depth >= _DEEPEST:
        return None
    if isinstance(value, dict):
        items = ((str(key), item, to_json_data(item, depth + 1)) for key, item in value.items())
        return {key: data for key, item, data in items if data is not None or item is None}
    if isinstance(value, (list, tuple)):
        return [to_json_data(item, depth + 1) for item in value]
    return None
