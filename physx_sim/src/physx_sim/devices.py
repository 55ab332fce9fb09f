"""Periods of motors and sensors, and lookup of the joints and bodies they are attached to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.errors import ComponentNotFoundError, ConfigError


def steps_of(option: str, period: float | None, physics: float) -> int:
    """Return the number of physics steps in a period; 1 for None.

    Args:
        option: Name of the period in error messages.
        period: In s.
        physics: The physics period, in s.

    Raises:
        ConfigError: If it is not a multiple of the physics period.
    """
    if period is None:
        return 1
    steps = round(period / physics)
    if steps < 1 or abs(steps * physics - period) > 1e-9 * period:
        raise ConfigError(
            f"{option} is {period:g} s but must be a multiple of the physics period, {physics:g} s."
        )
    return steps


def places_of(kind: str, names: Iterable[str], known: Mapping[str, int] | Sequence[str]) -> Any:
    """Return the indices of joints or bodies as an array.

    Args:
        kind: ``"joint"`` or ``"body"``.
        names: Names to look up.
        known: Indices by name, or names in order.
    """
    places = known if isinstance(known, Mapping) else {name: i for i, name in enumerate(known)}
    found = []
    for name in names:
        if name not in places:
            raise ComponentNotFoundError(kind, str(name), "The simulation", places)
        found.append(places[name])
    return np.array(found, np.intp)


def as_slice(places: Any) -> Any:
    """Return consecutive indices as a slice, which is faster to index with."""
    first = int(places[0])
    if (places == np.arange(first, first + len(places))).all():
        return slice(first, first + len(places))
    return places


def check_unique(kind: str, names: Sequence[str]) -> None:
    """Check that there is at least one name and that all names differ."""
    if not names:
        raise ConfigError(f"There are no {kind.split()[0]}.")
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f'There are {names.count(name)} {kind} "{name}".')
