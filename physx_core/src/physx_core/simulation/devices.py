"""What motors and sensors have in common: their periods, and the names that they stand on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.errors import ComponentNotFoundError, ConfigError


def steps_of(option: str, period: float | None, physics: float) -> int:
    """Return how many physics steps a period has; None: one.

    Args:
        option: What to call the period in an error.
        period: In s.
        physics: The physics' period, in s.

    Raises:
        ConfigError: It is no multiple of the physics' period.
    """
    if period is None:
        return 1
    steps = round(period / physics)
    if steps < 1 or abs(steps * physics - period) > 1e-9 * period:
        raise ConfigError(
            f"{option} is {period:g} s but must be a multiple of the physics' period, "
            f"{physics:g} s."
        )
    return steps


def places_of(kind: str, names: Iterable[str], known: Mapping[str, int] | Sequence[str]) -> Any:
    """Return the places of joints or bodies as an array.

    Args:
        kind: ``"joint"`` or ``"body"``.
        names: Names to look up.
        known: All there are: places by name, or names in order.

    Raises:
        ComponentNotFoundError: One is not there.
    """
    places = known if isinstance(known, Mapping) else {name: i for i, name in enumerate(known)}
    found = []
    for name in names:
        if name not in places:
            raise ComponentNotFoundError(kind, str(name), "The simulation", places)
        found.append(places[name])
    return np.array(found, np.intp)


def as_slice(places: Any) -> Any:
    """Return places as a slice if they follow each other, which is quicker to use."""
    first = int(places[0])
    if (places == np.arange(first, first + len(places))).all():
        return slice(first, first + len(places))
    return places


def check_unique(kind: str, names: Sequence[str]) -> None:
    """Check that names differ.

    Raises:
        ConfigError: Two are the same, or there are none.
    """
    if not names:
        raise ConfigError(f"There is no {kind}.")
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f'There are {names.count(name)} of {kind} "{name}".')
