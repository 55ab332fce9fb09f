"""UNetTransformation: pads grids for a UNet, and crops its predictions."""

from __future__ import annotations

from collections.abc import Mapping

from physx_core import Network, Normalization
from physx_core.errors import ConfigError
from physx_core.typing import Tensors
from physx_torch.networks.grid import crop, pad, to_grid
from physx_torch.networks.transformation import TorchTransformation
from physx_torch.networks.unet import UNet


class UNetTransformation(TorchTransformation):
    """Normalizes like `TorchTransformation`, and converts fields to the grid of a `UNet`.

    Inputs are padded with zeros to the smallest size that the network accepts. Predictions are
    cropped to the grid and reshaped like their target fields, with each value at its point. Targets
    are multiplied by `UNet.data_scale`, and predictions divided by it.
    """

    def __init__(self) -> None:
        super().__init__()
        self._network: UNet | None = None

    def set_normalization(
        self, normalization: Mapping[str, Normalization], network: Network
    ) -> None:
        """Set the coefficients and the network, whose fields must already be bound.

        Raises:
            ConfigError: If the network is not a UNet.
        """
        if not isinstance(network, UNet):
            raise ConfigError(f"{type(network).__name__} is not a UNet: omit its transformation.")
        super().set_normalization(normalization, network)
        self._network = network

    def transform_before_prediction(self, data: Tensors) -> Tensors:
        """Return the data with `net_fields` normalized, as padded grids."""
        network, data = self._unet(), super().transform_before_prediction(data)
        grids = {
            name: pad(
                to_grid(data[name], network.size, network.layouts[name].channels), network.borders
            )
            for name in network.net_fields
            if name in data
        }
        return {**data, **grids}

    def transform_before_loss(
        self, prediction: Tensors, targets: Tensors
    ) -> tuple[Tensors, Tensors]:
        """Return the prediction with the fields' shapes, and the targets normalized and scaled."""
        prediction, targets = super().transform_before_loss(self._crop(prediction), targets)
        scale = self._unet().data_scale
        if scale != 1:
            targets = {name: values * scale for name, values in targets.items()}
        return prediction, targets

    def transform_before_apply(self, prediction: Tensors) -> Tensors:
        """Return the prediction with the fields' shapes and in physical units."""
        prediction = self._crop(prediction)
        scale = self._unet().data_scale
        if scale != 1:
            prediction = {name: values / scale for name, values in prediction.items()}
        return super().transform_before_apply(prediction)

    def _crop(self, prediction: Tensors) -> Tensors:
        network = self._unet()
        pairs = zip(network.pred_fields, network.opt_fields, strict=True)
        fields = {
            pred: crop(prediction[pred], network.borders).reshape(-1, *network.layouts[opt].shape)
            for pred, opt in pairs
            if pred in prediction
        }
        return {**prediction, **fields}

    def _unet(self) -> UNet:
        if self._network is None or not self._network.borders:
            raise ConfigError("UNetTransformation needs a UNet whose fields are bound.")
        return self._network
