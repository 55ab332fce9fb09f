"""Observer block whose feature is a quantity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from physx_core.errors import ConfigError
from physx_gym.blocks.block import ObserverBlock
from physx_gym.tasks.quantities import Quantity

if TYPE_CHECKING:
    from physx_gym.env.pipeline_env import PipelineEnv


class QuantityObserver(ObserverBlock):
    """Observes the value of a quantity, which is computed from the true state of the simulation.

    Its feature is the value: an array, of shape () for a number.

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
            ConfigError: If it is not a quantity, or its value is not numeric.
        """
        super().__init__(name, env, update_ratio=update_ratio)
        if not isinstance(quantity, Quantity):
            raise ConfigError(f'QuantityObserver "{name}": {quantity!r} is not a Quantity.')
        self.quantity = quantity
        self.refresh_connection()

    def connect(self) -> None:
        """Create a buffer of the quantity's current shape.

        Raises:
            ConfigError: If the quantity is neither a number nor an array of numbers.
        """
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
        self._set_observation_space(spaces.Box(-np.inf, np.inf, shape, np.float64))

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Update the value."""
        self.observation[...] = self.env.quantities.get_value(self.quantity)
