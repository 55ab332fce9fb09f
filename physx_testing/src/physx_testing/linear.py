"""A NumPy network for checks of transformations that specify none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from physx_core.components import Network
from physx_core.fields import Field
from physx_core.typing import Array, Tensors


class LinearNetwork(Network):
    """Predicts a field as a fixed linear function of another."""

    def __init__(self) -> None:
        self.weights: Array = np.zeros((0, 0))
        self._shape: tuple[int, ...] = ()

    def bind(self, fields: Mapping[str, Field]) -> None:
        """Read the shapes of the fields."""
        super().bind(fields)
        sizes = [
            int(np.prod(fields[name].shape or ())) for name in (*self.net_fields, *self.opt_fields)
        ]
        self._shape = fields[self.opt_fields[0]].shape or ()
        self.weights = np.cos(np.arange(float(np.prod(sizes)))).reshape(sizes)

    def predict(self, data: Tensors) -> Tensors:
        """Return the linear function."""
        values = data[self.net_fields[0]]
        flat = values.reshape(len(values), -1) @ self.weights
        return {self.pred_fields[0]: flat.reshape(len(values), *self._shape)}

    def get_parameters(self) -> dict[str, Any]:
        """Return the weights."""
        return {"weights": self.weights}
