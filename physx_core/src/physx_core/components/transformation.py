"""Transformation: base class for converting tensors between dataset, network and environment."""

from __future__ import annotations

from collections.abc import Mapping

from physx_core.components.increments import Increments
from physx_core.components.network import Network
from physx_core.normalization import Normalization
from physx_core.typing import Tensors


class Transformation:
    """The identity; plugins derive their own.

    Of targets that are increments, it gets and returns the changes.

    Attributes:
        normalization: Mean and standard deviation by field; empty if nothing is normalized. They
            are stored in checkpoints.
        increments: The targets that are increments; None: there are none.
    """

    increments: Increments | None = None

    def __init__(self) -> None:
        self.normalization: dict[str, Normalization] = {}

    def set_normalization(
        self, normalization: Mapping[str, Normalization], network: Network
    ) -> None:
        """Set the coefficients; called before the first batch and whenever they change.

        Raises:
            ConfigError: If a target is the increment of what the network does not read.
        """
        self.normalization = dict(normalization)
        self.increments = Increments(network, normalization) or None

    def transform_before_prediction(self, data: Tensors) -> Tensors:
        """Return the network's inputs, from data in physical units.

        Args:
            data: The network's `net_fields`.
        """
        return data

    def transform_before_loss(
        self, prediction: Tensors, targets: Tensors
    ) -> tuple[Tensors, Tensors]:
        """Return prediction and targets as the loss compares them.

        Args:
            prediction: The network's prediction.
            targets: The network's `opt_fields` in physical units.
        """
        return prediction, targets

    def transform_before_apply(self, prediction: Tensors) -> Tensors:
        """Return the prediction for the environment, in physical units.

        Args:
            prediction: The network's prediction.
        """
        return prediction
