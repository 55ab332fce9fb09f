"""Mean and standard deviation per component, accumulated block by block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core.fields import Array


@dataclass(frozen=True)
class Normalization:
    """Mean and standard deviation of each component of a field.

    Attributes:
        mean: Mean, of the field's shape, float64, in the field's unit.
        std: Standard deviation, of the field's shape, float64, in the field's unit; 1 for a
            component that never changes, so that normalizing only shifts it to 0.
    """

    mean: Array
    std: Array

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON or TOML."""
        return {"mean": self.mean.tolist(), "std": self.std.tolist()}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Normalization:
        """Make what `to_dict` described."""
        return cls(np.asarray(plain["mean"], np.float64), np.asarray(plain["std"], np.float64))
