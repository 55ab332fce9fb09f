"""Hand: what a person changes in a running environment, as numbers that its rows keep."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from physx_core.components.parameter import Parameter
from physx_core.errors import UsageError
from physx_core.fields import Field
from physx_core.typing import Array

if TYPE_CHECKING:
    from physx_core.components.environment import Environment

HAND = "hand"
"""Name of the field: the values of the controls, and the pull."""
_NOBODY = (-1.0, 0.0, 0.0, 0.0, 0.0)
"""The pull of nobody: index of the object, node, and force."""


class Hand:
    """Applies what a person does to an environment before a row, or what a stored row tells.

    It is one vector for each row: the values of the controls, one for each element, then the pull:
    the index of the object among those that can be pulled, or -1; the node; and the force, (3,).
    All that the environment is told follows from these vectors, in their order, so the rows can be
    simulated again, bit by bit.

    Attributes:
        field: The field of rows that keeps the vector.
    """

    def __init__(
        self,
        environment: Environment,
        controls: Sequence[Parameter],
        values: Mapping[str, Any],
        pulls: Sequence[str],
        ask: Callable[[], Sequence[float]],
    ) -> None:
        """Begin with the values that the environment has.

        Args:
            environment: The environment.
            controls: What can be changed.
            values: Their values, in their shapes.
            pulls: Names of the objects that can be pulled.
            ask: Returns the vector for the next row; empty: nobody does anything.

        Raises:
            UsageError: If a value is missing, or outside its bounds.
        """
        self._environment, self._ask = environment, ask
        self._controls, self._pulls = list(controls), list(pulls)
        begin = [_flat(environment, each, values.get(each.name)) for each in controls]
        self._begin = np.concatenate([*begin, _NOBODY])
        self._present = self._begin.copy()
        self._repeats = False
        self.field = Field(HAND, self._begin.shape, "float64", role="additional")

    def describe(self) -> dict[str, Any]:
        """Return what viewers show: names, bounds and values of the controls, what can be pulled.

        Each element of a control has a slider of its own.
        """
        return {
            "labels": [label for each in self._controls for label in each.columns],
            "low": [low for each in self._controls for low in each.low],
            "high": [high for each in self._controls for high in each.high],
            "values": self._begin[: -len(_NOBODY)].tolist(),
            "pulls": self._pulls,
        }

    def act(self) -> Array:
        """Tell the environment what is done before a row; return the vector.

        Raises:
            UsageError: If the vector has another length, or holds NaN or infinity.
        """
        told = self._present if self._repeats else np.array(self._ask(), np.float64)
        if not told.size:
            told = np.concatenate([self._present[: -len(_NOBODY)], _NOBODY])
        if told.shape != self._present.shape or not np.isfinite(told).all():
            raise UsageError(
                f"A viewer has sent {told!r:.200} as what a person does, but it must be "
                f"{len(self._present)} finite numbers."
            )
        self._repeats = False
        self._apply(told)
        return told.copy()

    def repeat(self) -> None:
        """Do the same again next: the row was not kept, but the next one is in its place."""
        self._repeats = True

    def let_go(self) -> None:
        """End what is done, before another independent episode."""
        self._apply(self._begin.copy())
        self._repeats = False

    def get_state(self) -> list[float]:
        """Return the vector of the last row."""
        state: list[float] = self._present.tolist()
        return state

    def set_state(self, state: Sequence[float]) -> None:
        """Go on from a state; the environment itself has its own."""
        self._present = np.array(state, np.float64)

    def _apply(self, told: Array) -> None:
        before, self._present = self._present, told
        place = 0
        for each in self._controls:
            new = told[place : place + each.size]
            if (new != before[place : place + each.size]).any():
                self._environment.perturb(**{each.name: _value(each, new)})
            place += each.size
        held, pulled = before[place:], told[place:]
        if held[0] >= 0 and (held[:2] != pulled[:2]).any():
            self._environment.pull(self._pulls[int(held[0])], int(held[1]), np.zeros(3))
        if pulled[0] >= 0:
            self._environment.pull(self._pulls[int(pulled[0])], int(pulled[1]), pulled[2:].copy())


def _flat(environment: Environment, control: Parameter, value: Any) -> Array:
    """Return the value of a control, one number for each element."""
    name = control.name
    given = getattr(environment, name, None) if value is None else value
    try:
        flat = np.broadcast_to(np.asarray(given, np.float64), control.shape).ravel()
    except (TypeError, ValueError):
        flat = np.full(control.size, np.nan)
    low, high = control.low, control.high
    if low is None or high is None:
        raise UsageError(f"The control {name} needs bounds: low and high.")
    if not ((np.array(low) <= flat) & (flat <= np.array(high))).all():
        raise UsageError(
            f"{type(environment).__name__}.{name} is {given!r:.100}, but a control of that name "
            f"needs a value of shape {control.shape} from {low} to {high} when init() ends: set "
            f"it there, or give it: define_controls(..., {name}=...)."
        )
    return flat


def _value(control: Parameter, elements: Array) -> Any:
    """Return the value that `Environment.perturb` gets."""
    if control.shape:
        return elements.reshape(control.shape).copy()
    return int(elements[0]) if control.distribution == "integer" else float(elements[0])
