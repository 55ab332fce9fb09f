"""The observers that the user chose to send a run's numbers to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from physx_core.components.visualizer import Observer
from physx_core.config import EnvironmentConfig
from physx_core.errors import UnknownOptionError
from physx_core.plugins import resolve


def statistics_observers(
    given: Sequence[str | type[Any]],
    kwargs: Mapping[str, Mapping[str, Any]],
    environment: EnvironmentConfig | None,
) -> list[Observer]:
    """Return the observers that numbers go to.

    Args:
        given: References of visualizers; a text is one of them.
        kwargs: Keyword arguments by reference.
        environment: Its visualizer sees the numbers anyway and is not made twice.

    Raises:
        UnknownOptionError: There are arguments for something else.
        PhysxError: A reference leads nowhere.
    """
    references = [given] if isinstance(given, str) else list(given)
    unknown = kwargs.keys() - set(map(str, references))
    if unknown:
        raise UnknownOptionError("statistics_kwargs", unknown, map(str, references))
    drawn = environment.visualizer if environment is not None else None
    return [
        resolve("visualizer", reference)(**kwargs.get(str(reference), {}))
        for reference in references
        if reference != drawn
    ]
