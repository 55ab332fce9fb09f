"""Base class of randomizations, whose values are drawn for an episode."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.random import Generator

from physx_core import checks
from physx_core.errors import ComponentNotFoundError, ConfigError
from physx_gym.env.pipeline_env import PipelineEnv

Range = Sequence[float]
"""Lowest and highest value of a uniform distribution."""
Drawn = dict[str, Any]
"""Drawn values by name: numbers, and lists of them."""


@dataclass(frozen=True)
class Nominal:
    """An environment as it was before anything was randomized.

    Attributes:
        env: The environment.
        options: Options of its simulator, as in `Simulator.get_options`.
    """

    env: PipelineEnv
    options: Mapping[str, Any]


class Randomization(ABC):
    """Properties that are drawn from ranges for an episode.

    Subclasses implement `draw`, and `options` or `apply`.

    Attributes:
        name: Its name in the log.
    """

    def __init__(self, name: str | None = None) -> None:
        """Set the name; None: that of the class."""
        self.name = type(self).__name__ if name is None else name

    @abstractmethod
    def draw(self, nominal: Nominal, random: Generator) -> Drawn:
        """Draw the values for an episode; return plain data, which goes into the log.

        Raises:
            ComponentNotFoundError: If a name is not found in the environment.
        """

    def options(self, nominal: Nominal, drawn: Drawn) -> Mapping[str, Any]:
        """Return the options of the simulator that differ, as in `Simulator.set_options`."""
        return {}

    def apply(self, env: PipelineEnv, drawn: Drawn) -> None:  # noqa: B027 - not all need this
        """Apply what is not an option of the environment's simulator; called at each reset."""


def check_range(option: str, given: Any, lowest: float | None = 0.0) -> tuple[float, float]:
    """Return a range after checking that its values are not below the lowest allowed one."""
    low, high = checks.vector(option, given, 2)
    if low > high or (lowest is not None and low < lowest):
        limit = "" if lowest is None else f" and not below {lowest:g}"
        raise ConfigError(f"{option} is {given!r} but must be [low, high]{limit}.")
    return low, high


def chosen(
    kind: str, where: str, names: Iterable[str] | None, known: Sequence[str]
) -> tuple[str, ...]:
    """Return the given names after checking that they are known; None: all."""
    if isinstance(names, str):
        names = (names,)
    wanted = tuple(known if names is None else names)
    for each in wanted:
        if each not in known:
            raise ComponentNotFoundError(kind, each, where, known)
    return wanted
