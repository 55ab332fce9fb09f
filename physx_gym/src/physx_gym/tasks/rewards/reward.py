"""Base class of rewards, and rewards of a single quantity."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from physx_core import checks
from physx_core.errors import ConfigError
from physx_gym.tasks.quantities import Quantities, Quantity, Reference
from physx_gym.tasks.quantities.quantity import as_array, check_quantity

_AT_CUTOFF = math.log(0.01)


class Reward(ABC):
    """A reward, or a part of one.

    Attributes:
        name: Its name in the info of a step.
        is_normalized: Whether it is always between 0 and 1.
    """

    is_normalized: bool = False

    def __init__(self, name: str) -> None:
        """Name the reward.

        Raises:
            ConfigError: If the name is empty or not a string.
        """
        if not isinstance(name, str) or not name:
            raise ConfigError(f"The name of a reward must be a string, not {name!r}.")
        self.name = name

    @property
    def watched(self) -> tuple[Quantity, ...]:
        """Quantities that the reward is computed from."""
        return ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the reward and its parts."""
        return (self.name,)

    @abstractmethod
    def compute(self, quantities: Quantities, terminated: bool, info: dict[str, float]) -> float:
        """Return the reward of the step.

        Args:
            quantities: Quantities of the environment.
            terminated: Whether the step terminated the episode.
            info: Composed rewards add their parts to it, by name.
        """


class Survival(Reward):
    """1 for every step that does not terminate the episode, otherwise 0."""

    is_normalized = True

    def __init__(self, name: str = "survival") -> None:
        """Name the reward."""
        super().__init__(name)

    def compute(self, quantities: Quantities, terminated: bool, info: dict[str, float]) -> float:
        """Return 1 or 0."""
        return 0.0 if terminated else 1.0


class Minimizing(Reward):
    """1 if a quantity is 0, decreasing as it grows: 0.01 at the cutoff.

    The reward is ``exp(ln(0.01) * (|quantity| / cutoff) ** 2)``, with the Euclidean norm of all
    entries.
    """

    is_normalized = True

    def __init__(self, quantity: Quantity, cutoff: float, name: str | None = None) -> None:
        """Choose the quantity.

        Args:
            quantity: A number or array.
            cutoff: Norm of the quantity, in its unit, at which the reward is 0.01.
            name: Name; None: that of the quantity's class.

        Raises:
            ConfigError: If it is not a quantity, or the cutoff is not positive.
        """
        self.quantity = check_quantity(f"{type(self).__name__}.quantity", quantity)
        super().__init__(name or type(quantity).__name__)
        self.cutoff = checks.positive(f'cutoff of "{self.name}"', cutoff)

    @property
    def watched(self) -> tuple[Quantity, ...]:
        """The quantity."""
        return (self.quantity,)

    def compute(self, quantities: Quantities, terminated: bool, info: dict[str, float]) -> float:
        """Return the reward."""
        return self._kernel(quantities.get_value(self.quantity))

    def _kernel(self, error: Any) -> float:
        values = as_array(error).ravel()
        return math.exp(_AT_CUTOFF * float(values @ values) / self.cutoff**2)


class Tracking(Minimizing):
    """`Minimizing` of the difference between a quantity and its target."""

    def __init__(
        self,
        quantity: Quantity,
        cutoff: float,
        target: Quantity | float | tuple[float, ...] | None = None,
        difference: Callable[[Any, Any], Any] = np.subtract,
        name: str | None = None,
    ) -> None:
        """Choose the quantity and its target.

        Args:
            quantity: A number or array.
            cutoff: Norm of the difference at which the reward is 0.01.
            target: A quantity or a constant; None: the quantity on the reference trajectory.
            difference: Function of value and target; for angles, one that takes the shorter arc.
            name: Name; None: that of the quantity's class.
        """
        super().__init__(quantity, cutoff, name)
        self.target = Reference(quantity) if target is None else target
        self.difference = difference

    @property
    def watched(self) -> tuple[Quantity, ...]:
        """The quantity and its target."""
        target = self.target
        return (self.quantity, target) if isinstance(target, Quantity) else (self.quantity,)

    def compute(self, quantities: Quantities, terminated: bool, info: dict[str, float]) -> float:
        """Return the reward.

        Raises:
            ConfigError: If the shapes of the quantity and its target do not fit.
        """
        target = self.target
        wanted = quantities.get_value(target) if isinstance(target, Quantity) else target
        value = quantities.get_value(self.quantity)
        try:
            error = self.difference(as_array(value), as_array(wanted))
        except ValueError as cause:
            raise ConfigError(
                f'The reward "{self.name}" compares a value of shape {np.shape(value)} with a '
                f"target of shape {np.shape(wanted)}: {cause}"
            ) from cause
        return self._kernel(error)
