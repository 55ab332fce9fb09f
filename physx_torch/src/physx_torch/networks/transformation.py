"""TorchTransformation: normalizes inputs and targets, and denormalizes predictions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch

from physx_core import Network, Normalization, Transformation
from physx_core.errors import ConfigError
from physx_core.typing import Tensors
from physx_torch.networks.network import TorchNetwork


class _Scale(NamedTuple):
    """Mean and standard deviation of a field, or of its logarithm, as tensors of their shape."""

    mean: torch.Tensor
    std: torch.Tensor
    log: bool


class TorchTransformation(Transformation):
    """Normalizes fields to mean 0 and standard deviation 1 for the network and the loss.

    Fields of `net_fields` and `opt_fields` are normalized with their own coefficients; the i-th of
    `pred_fields` is converted to physical units with those of the i-th of `opt_fields`. Fields
    without coefficients are unchanged. What was constant in all samples is predicted as it was.

    Everything is computed in the network's data type: in float32, values with a large offset (1e6
    standard deviations) lose their last digits before the mean is subtracted; use float64 for
    those.
    """

    def __init__(self) -> None:
        super().__init__()
        self._inputs: dict[str, _Scale] = {}
        self._targets: dict[str, _Scale] = {}
        self._predictions: dict[str, _Scale] = {}

    def set_normalization(
        self, normalization: Mapping[str, Normalization], network: Network
    ) -> None:
        """Set the coefficients as tensors with the network's device and data type.

        Call it again after changing the network's device or data type.

        Args:
            normalization: Mean and standard deviation by field; fields that the network does not
                use are ignored.
            network: The network whose fields are transformed.

        Raises:
            ConfigError: If the network is not a PyTorch network.
        """
        if not isinstance(network, TorchNetwork):
            raise ConfigError(f"{type(network).__name__} is not a TorchNetwork.")
        super().set_normalization(normalization, network)
        scales = {name: _scale(item, network) for name, item in normalization.items()}
        self._inputs = {n: scales[n] for n in network.net_fields if n in scales}
        self._targets = {n: scales[n] for n in network.opt_fields if n in scales}
        pairs = zip(network.pred_fields, network.opt_fields, strict=False)
        self._predictions = {
            pred: _with_constants(scales[opt], normalization[opt])
            for pred, opt in pairs if opt in scales
        }  # fmt: skip

    def transform_before_prediction(self, data: Tensors) -> Tensors:
        """Return the data with `net_fields` normalized."""
        return _normalize(data, self._inputs) if self._inputs else data

    def transform_before_loss(
        self, prediction: Tensors, targets: Tensors
    ) -> tuple[Tensors, Tensors]:
        """Return the prediction unchanged, and the targets normalized."""
        return prediction, _normalize(targets, self._targets) if self._targets else targets

    def transform_before_apply(self, prediction: Tensors) -> Tensors:
        """Return the prediction in physical units."""
        if not self._predictions:
            return prediction
        changed = dict(prediction)
        for name, scale in self._predictions.items():
            if name in prediction:
                values = torch.addcmul(scale.mean, prediction[name], scale.std)
                changed[name] = values.exp() if scale.log else values
        return changed


def _scale(item: Normalization, network: TorchNetwork) -> _Scale:
    mean, std = (
        torch.tensor(values, dtype=network.data_type, device=network.device)
        for values in (item.mean, item.std)
    )
    return _Scale(mean, std, item.log)


def _with_constants(scale: _Scale, item: Normalization) -> _Scale:
    """Return a scale by which whatever a network says of a constant becomes that constant."""
    constant = torch.from_numpy(np.asarray(item.is_constant)).to(scale.std.device)
    return scale._replace(std=scale.std.masked_fill(constant, 0.0))


def _normalize(data: Tensors, scales: Mapping[str, _Scale]) -> Tensors:
    changed = dict(data)
    for name, scale in scales.items():
        if name in data:
            values = data[name].log() if scale.log else data[name]
            changed[name] = (values - scale.mean) / scale.std
    return changed
