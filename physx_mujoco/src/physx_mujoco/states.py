"""States of MuJoCo's own objects, for environments that others have written with them."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from physx_core.states import StateAdapter

_ADDRESSES = {"plugin_data"}
_names: dict[type[Any], list[str]] = {}
"""Names of the parts of each class's objects."""


class _Numbers(StateAdapter):
    """An object of arrays and numbers, all of which may change."""

    def parts(self, value: Any) -> dict[str, Any]:
        """Return the arrays that are always there, and the numbers that can be set."""
        kind = type(value)
        if kind not in _names:
            _names[kind] = _names_in(value)
        return {name: getattr(value, name) for name in _names[kind]}

    def assign(self, value: Any, parts: dict[str, Any]) -> None:
        """Set the numbers."""
        for name, number in parts.items():
            setattr(value, name, number)


class SettingsState(_Numbers):
    """Options or statistics of a model."""


class ModelState(_Numbers):
    """A model, of which an environment may change masses, height fields, and all that is simulated.

    What is only drawn is no part of states.
    """

    def parts(self, value: Any) -> dict[str, Any]:
        """Return its arrays and settings."""
        return super().parts(value) | {"opt": value.opt, "stat": value.stat}


class DataState(_Numbers):
    """A simulation.

    Contacts and constraints, whose memory MuJoCo lays out anew in each step, are those at the
    restored positions until the next step; MuJoCo has those from before the last one.
    """

    def parts(self, value: Any) -> dict[str, Any]:
        """Return all that has been computed, and the model."""
        return super().parts(value) | {"model": value.model}

    def settle(self, value: Any) -> None:
        """Find the contacts and constraints."""
        mujoco.mj_forward(value.model, value)


def _names_in(value: Any) -> list[str]:
    """Return the names of the arrays that stay the same objects, and of numbers that can be set."""
    names = []
    for name in sorted(set(dir(value)) - _ADDRESSES):
        found = None if name.startswith("_") else getattr(value, name)
        if isinstance(found, np.ndarray):
            is_part = found.flags.writeable and found is getattr(value, name)
        else:
            is_part = isinstance(found, (int, float)) and _is_settable(value, name, found)
        if is_part:
            names.append(name)
    return names


def _is_settable(value: Any, name: str, number: Any) -> bool:
    try:
        setattr(value, name, number)
    except AttributeError:
        return False
    return True
