"""Types of the values that components exchange, for annotations in plugins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["Array", "Batch", "Color", "Records", "Sample", "Tensors", "Vector"]

Array: TypeAlias = NDArray[Any]
"""An array of numbers of any shape and type."""
Sample: TypeAlias = dict[str, Array]
"""One step: field name to array of the field's shape."""
Batch: TypeAlias = dict[str, Array]
"""Several steps: field name to array of shape (samples, *field shape)."""
Tensors: TypeAlias = dict[str, Any]
"""Field name to a tensor of the network's library with a leading sample axis."""
Vector: TypeAlias = NDArray[np.float64]
"""An array of float64, for example positions, shape (nq,)."""
Index: TypeAlias = NDArray[np.intp]
"""Row indices."""
Records: TypeAlias = NDArray[np.void]
"""A record array: one row of named columns for each contact or ray."""
Color: TypeAlias = str | Sequence[float]
"""A name such as ``"green"``, ``"#rrggbb"``, or red, green, and blue in [0, 1]."""
