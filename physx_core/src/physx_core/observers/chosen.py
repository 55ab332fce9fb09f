"""Creates the observers that a user chose for a run's statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from physx_core.components.visualizer import Observer
from physx_core.config import EnvironmentConfig
from physx_core.errors import ConfigError, UnknownOptionError
from physx_core.plugins import create


def statistics_observers(
    given: Sequence[str | type[Any]],
    kwargs: Mapping[str, Mapping[str, Any]],
    environment: EnvironmentConfig | None,
) -> list[Observer]:
    """Return the observers of a run's statistics.

    Args:
        given: References of visualizers; a string is a single reference.
        kwargs: Keyword arguments by reference.
        environment: Its visualizer receives the statistics anyway and is not created again.

    Raises:
        UnknownOptionError: If there are arguments for a reference that was not given.
        ConfigError: If the arguments of a reference are not a table.
        PhysxError: If a reference cannot be resolved, or does not accept its arguments.
    """
    references = [given] if isinstance(given, str) else list(given)
    unknown = kwargs.keys() - set(map(str, references))
    if unknown:
        raise UnknownOptionError("statistics_kwargs", unknown, map(str, references))
    for name, options in kwargs.items():
        if not isinstance(options, Mapping):
            raise ConfigError(
                f"The statistics_kwargs of {name} are {options!r:.100} but must be a table: "
                f"""{{"{name}": {{"option": 1}}}}, on the command line '{name}={{option=1}}'."""
            )
    drawn = environment.visualizer if environment is not None else None
    return [
        create("visualizer", reference, kwargs.get(str(reference), {}))
        for reference in references
        if reference != drawn
    ]
