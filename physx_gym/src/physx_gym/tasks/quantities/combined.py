"""Quantities that are computed from others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.tasks.quantities.quantity import Moment, Quantity, Remembering, as_array


@dataclass(frozen=True)
class Masked(Quantity):
    """Some entries of another quantity, flat.

    Attributes:
        quantity: An array.
        entries: Indices in the flat array.
    """

    quantity: Quantity
    entries: tuple[int, ...]

    def compute(self, moment: Moment) -> Any:
        """Return the entries, shape (entries,)."""
        return as_array(moment.get(self.quantity)).ravel()[list(self.entries)]


@dataclass(frozen=True)
class Joined(Quantity):
    """Several quantities, concatenated into one flat array.

    Attributes:
        quantities: Numbers or arrays.
    """

    quantities: tuple[Quantity, ...]

    def compute(self, moment: Moment) -> Any:
        """Return all entries in one array."""
        return np.concatenate([as_array(moment.get(each)).ravel() for each in self.quantities])


@dataclass(frozen=True)
class Computed(Quantity):
    """A function of other quantities.

    Attributes:
        function: Called with their values; must be a named function, for equal ones to be shared.
        quantities: Its arguments.
    """

    function: Callable[..., Any]
    quantities: tuple[Quantity, ...]

    def compute(self, moment: Moment) -> Any:
        """Return the value of the function."""
        return self.function(*(moment.get(each) for each in self.quantities))


@dataclass(frozen=True)
class Stacked(Remembering):
    """The values of another quantity after the last steps, oldest first.

    Attributes:
        quantity: A number or array.
        steps: Number of steps; at the start of an episode there are fewer.

    Raises:
        ConfigError: If `steps` is less than 1, or `quantity` is not a quantity.
    """

    quantity: Quantity
    steps: int

    def __post_init__(self) -> None:
        """Check the number of steps."""
        super().__post_init__()
        if self.steps < 1:
            raise ConfigError(f"Stacked needs at least 1 step, not {self.steps}.")

    def advance(self, memory: Any, moment: Moment) -> tuple[Any, Any]:
        """Add the present value: shape (steps so far, *shape)."""
        stack = _push(memory, moment.get(self.quantity), self.steps)
        return stack, stack


@dataclass(frozen=True)
class Delta(Remembering):
    """The change of another quantity over the last steps; 0 at the start of an episode.

    Attributes:
        quantity: A number or array.
        steps: Number of steps; fewer at the start of an episode.
        difference: Takes the later and the earlier value; for angles, one along the shorter arc.
    """

    quantity: Quantity
    steps: int = 1
    difference: Callable[[Any, Any], Any] = np.subtract

    def advance(self, memory: Any, moment: Moment) -> tuple[Any, Any]:
        """Return the change."""
        stack = _push(memory, moment.get(self.quantity), self.steps + 1)
        return as_array(self.difference(stack[-1], stack[0])), stack


@dataclass(frozen=True)
class Rate(Quantity):
    """The rate of change of another quantity over the last step, per second.

    Attributes:
        quantity: A number or array.
        difference: As in `Delta`.
    """

    quantity: Quantity
    difference: Callable[[Any, Any], Any] = np.subtract

    def compute(self, moment: Moment) -> Any:
        """Return the mean rate over the step."""
        return moment.get(Delta(self.quantity, 1, self.difference)) / moment.step_dt


@dataclass(frozen=True)
class Mean(Quantity):
    """The mean of another quantity over the last steps.

    Attributes:
        quantity: A number or array.
        steps: Number of steps; fewer at the start of an episode.
    """

    quantity: Quantity
    steps: int

    def compute(self, moment: Moment) -> Any:
        """Return the mean."""
        return moment.get(Stacked(self.quantity, self.steps)).mean(axis=0)


def _push(stack: Any, value: Any, size: int) -> Vector:
    """Return the newest values of a stack after adding one."""
    new = as_array(value)[np.newaxis].copy()
    return new if stack is None else np.concatenate([stack, new])[-size:]
