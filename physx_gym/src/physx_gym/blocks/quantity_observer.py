"""Quantities as features of observations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from physx_core.errors import ConfigError
from physx_gym.blocks.block import ObserverBlock
from physx_gym.tasks.quantities import Quantity

if TYPE_CHECKING:
    from physx_gym.env.layers.layer import PipelineEnv


class QuantityObserver(ObserverBlock):
    """Shows the value of a quantity; quantities know the simulation's true state.

    Its feature: the value, an array, or a number of shape ().

    Attributes:
        quantity: The quantity.
    """

    def __init__(
        self, name: str, env: PipelineEnv, *, update_ratio: int = 1, quantity: Quantity
    ) -> None:
        """Observe a quantity.

        Args:
            name: Name within the pipeline.
            env: The environment below.
            update_ratio: See `Block`.
            quantity: What to observe; its value is a number or an array.

        Raises:
            ConfigError: It is no quantity, or its value is no number.
        """
        super().__init__(name, env, update_ratio=update_ratio)
        if not isinstance(quantity, Quantity):
            raise ConfigError(f'QuantityObserver "{name}": {quantity!r} is no Quantity.')
        self.quantity = quantity
        self.refresh_connection()

    def connect(self) -> None:
        """Make a buffer of the form that the quantity has now."""
        quantities = self.env.quantities
        quantities.watch(self.quantity)
        value = quantities.get_value(self.quantity)
        try:
            shape = np.asarray(value, np.float64).shape
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f'QuantityObserver "{self.name}": {self.quantity} is {value!r}, which is neither a '
                "number nor an array of numbers."
            ) from error
        self._observe_in(spaces.Box(-np.inf, np.inf, shape, np.float64))

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Bring the value to the present."""
        self.observation[...] = self.env.quantities.get_value(self.quantity)
