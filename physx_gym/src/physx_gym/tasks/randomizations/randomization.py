"""Base class of what is drawn anew for an episode."""

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
"""The lowest and the highest value that is drawn; all between are equally likely."""
Drawn = dict[str, Any]
"""What was drawn, by name: numbers, and lists of them."""


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
    """Something that is drawn from ranges for an episode.

    Subclasses implement `draw`, and `options` or `apply`.

    Attributes:
        name: Its name in the log.
    """

    def __init__(self, name: str | None = None) -> None:
        """Name it; None: by its class."""
        self.name = type(self).__name__ if name is None else name

    @abstractmethod
    def draw(self, nominal: Nominal, random: Generator) -> Drawn:
        """Return what is drawn for an episode: plain data, which the log will contain.

        Raises:
            ComponentNotFoundError: If the environment lacks something that is named.
        """

    def options(self, nominal: Nominal, drawn: Drawn) -> Mapping[str, Any]:
        """Return the options of the simulator that differ, as in `Simulator.set_options`."""
        return {}

    def apply(self, env: PipelineEnv, drawn: Drawn) -> None:  # noqa: B027 - not all have this
        """Apply to an environment what is not an option of its simulator; called at each reset."""


def check_range(option: str, given: Any, lowest: float | None = 0.0) -> tuple[float, float]:
    """Return a range whose values are not below a lowest one."""
    low, high = checks.vector(option, given, 2)
    if low > high or (lowest is not None and low < lowest):
        limit = "" if lowest is None else f" and not below {lowest:g}"
        raise ConfigError(f"{option} is {given!r} but must be [low, high]{limit}.")
    return low, high


def chosen(
    kind: str, where: str, names: Iterable[str] | None, known: Sequence[str]
) -> tuple[str, ...]:
    """Return the names that are given, if they are known; None: all."""
    if isinstance(names, str):
        names = (names,)
    wanted = tuple(known if names is None else names)
    for each in wanted:
        if each not in known:
            raise ComponentNotFoundError(kind, each, where, known)
    return wanted
