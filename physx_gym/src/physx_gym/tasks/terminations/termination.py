"""Base class of terminations, and terminations on a single quantity."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from physx_core import checks
from physx_core.errors import ConfigError, UnknownOptionError
from physx_gym.tasks.quantities import Computed, Delta, Quantities, Quantity, Reference, Stacked
from physx_gym.tasks.quantities.quantity import as_array, check_quantity


class Termination(ABC):
    """A condition that ends an episode.

    Attributes:
        name: Its name in the info of the step.
        grace_period: Time at the start of an episode during which it does not apply, in s.
        is_truncation: Whether it truncates the episode instead of terminating it.
        training_only: Whether it does not apply in evaluation.
    """

    def __init__(
        self,
        name: str,
        *,
        grace_period: float = 0.0,
        is_truncation: bool = False,
        training_only: bool = False,
        **unknown: Any,
    ) -> None:
        """Store the options.

        Raises:
            UnknownOptionError: If there is no option of that name.
            ConfigError: If the name is empty or not a string, or the grace period is invalid.
        """
        if unknown:
            known = ("grace_period", "is_truncation", "training_only")
            raise UnknownOptionError(f'The termination "{name}"', unknown, known)
        if not isinstance(name, str) or not name:
            raise ConfigError(f"The name of a termination must be a string, not {name!r}.")
        self.name = name
        self.grace_period = checks.not_negative(f'grace_period of "{name}"', grace_period)
        self.is_truncation, self.training_only = bool(is_truncation), bool(training_only)

    @property
    def watched(self) -> tuple[Quantity, ...]:
        """Quantities that the condition is computed from."""
        return ()

    @abstractmethod
    def holds(self, quantities: Quantities) -> bool:
        """Return whether the condition holds after this step."""


class OutOfBounds(Termination):
    """Ends the episode when an entry of a quantity leaves its bounds."""

    def __init__(
        self,
        quantity: Quantity,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        name: str | None = None,
        **options: Any,
    ) -> None:
        """Choose the quantity.

        Args:
            quantity: A number or array.
            low: Lowest value, in the quantity's unit, for all entries or for each; None: no limit.
            high: Highest value, likewise.
            name: Name; None: that of the quantity's class.
            options: Options of `Termination`.

        Raises:
            ConfigError: If it is not a quantity, there are no bounds, or they are reversed.
        """
        self.quantity = check_quantity(f"{type(self).__name__}.quantity", quantity)
        super().__init__(name or type(quantity).__name__, **options)
        try:
            self.low = as_array(-np.inf if low is None else low)
            self.high = as_array(np.inf if high is None else high)
            fits = bool((self.low <= self.high).all())
        except (TypeError, ValueError):
            fits = False
        if not fits or (low is None and high is None):
            raise ConfigError(
                f'The bounds of "{self.name}" are {low!r} and {high!r} but must be numbers, the '
                "lower one first; one of them may be None."
            )

    @property
    def watched(self) -> tuple[Quantity, ...]:
        """The quantity."""
        return (self.quantity,)

    def holds(self, quantities: Quantities) -> bool:
        """Return whether an entry is out of bounds."""
        return self._is_out(quantities.get_value(self.quantity))

    def _is_out(self, value: Any) -> bool:
        try:
            return bool(((value < self.low) | (value > self.high)).any())
        except ValueError as error:
            raise ConfigError(
                f'The termination "{self.name}" compares a value of shape {np.shape(value)} with '
                f"bounds of shapes {self.low.shape} and {self.high.shape}: {error}"
            ) from error


class Drift(OutOfBounds):
    """Ends the episode when a quantity's change differs too much from that of its reference.

    The bounds apply to its change over a horizon minus that on the reference trajectory.
    """

    def __init__(
        self,
        quantity: Quantity,
        steps: int,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        name: str | None = None,
        *,
        difference: Callable[[Any, Any], Any] = np.subtract,
        **options: Any,
    ) -> None:
        """Choose the quantity.

        Args:
            quantity: A number or array.
            steps: The horizon, in steps of the environment.
            low: Lowest difference of the changes, as in `OutOfBounds`.
            high: Highest difference of the changes.
            name: Name; None: that of the quantity's class.
            difference: Function of two values; for angles, one that takes the shorter arc.
            options: Options of `Termination`.
        """
        own = Delta(quantity, steps, difference)
        wanted = Delta(Reference(quantity), steps, difference)
        drift = Computed(np.subtract, (own, wanted))
        super().__init__(drift, low, high, name or f"{type(quantity).__name__}_drift", **options)


class Shift(Termination):
    """Ends the episode when a quantity has been too far from its reference for a horizon."""

    def __init__(
        self,
        quantity: Quantity,
        steps: int,
        farthest: float,
        name: str | None = None,
        *,
        difference: Callable[[Any, Any], Any] = np.subtract,
        **options: Any,
    ) -> None:
        """Choose the quantity.

        Args:
            quantity: A number or array.
            steps: The horizon, in steps of the environment.
            farthest: Largest Euclidean distance, in the quantity's unit.
            name: Name; None: that of the quantity's class.
            difference: Function of two values; for angles, one that takes the shorter arc.
            options: Options of `Termination`.
        """
        super().__init__(name or f"{type(quantity).__name__}_shift", **options)
        error = Computed(difference, (quantity, Reference(quantity)))
        self.steps, self._errors = steps, Stacked(error, steps)
        self.farthest = checks.not_negative(f'farthest of "{self.name}"', farthest)

    @property
    def watched(self) -> tuple[Quantity, ...]:
        """The errors over the horizon."""
        return (self._errors,)

    def holds(self, quantities: Quantities) -> bool:
        """Return whether all errors of a full horizon are too large."""
        errors = quantities.get_value(self._errors)
        if len(errors) < self.steps:
            return False
        distances = np.linalg.norm(errors.reshape(len(errors), -1), axis=1)
        return bool(distances.min() > self.farthest)
