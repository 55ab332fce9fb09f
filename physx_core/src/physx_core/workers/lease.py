"""Lease: consecutive numbers of a campaign that one instance simulates, or goes on with."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from physx_core.components.parameter import Parameter
from physx_core.errors import PhysxError
from physx_core.typing import Batch
from physx_core.workers.instance import NO_VALUES

AIM = 20e-3
"""Time in s that the numbers of a lease should take; also the time after which rows are sent."""
_MOST, _MOST_VALUES = 4096, 2**20
_LOG = logging.getLogger("physx")


def say_without_states(instance_id: int, error: PhysxError) -> None:
    """Warn that an instance gives no states of episodes, or cannot go on from one."""
    _LOG.warning(
        "An episode whose simulation is lost, also in a run that is resumed, begins anew, as "
        "instance %d gives or takes no state. %s",
        instance_id,
        error,
    )


def most_numbers(parameters: Iterable[Parameter]) -> int:
    """Return how many numbers a lease may have: their parameters fit into 8 MiB."""
    size = sum(parameter.size for parameter in parameters)
    return max(1, min(_MOST, _MOST_VALUES // max(1, size)))


class EpisodeState(NamedTuple):
    """From where an episode can go on elsewhere.

    Attributes:
        episode: Its number.
        made: How many rows it has made before.
        state: Its encoded state.
    """

    episode: int
    made: int
    state: bytes


class Begun(NamedTuple):
    """What is stored of an episode that has not ended, and from where it goes on.

    Attributes:
        part: Number of its next part.
        rows: How many of its rows are stored.
        made: How many rows it had made before the state.
        state: Its encoded state; empty: there is none.
    """

    part: int
    rows: int
    made: int = 0
    state: bytes = b""


class Lease(NamedTuple):
    """Numbers to simulate, with their parameters.

    Attributes:
        numbers: The numbers; at least one.
        values: Name of a parameter to its values, an array of shape (numbers, *parameter's shape);
            empty if there are no parameters.
        begun: From where the only number goes on; None: the numbers begin.
    """

    numbers: range
    values: Batch
    begun: Begun | None = None

    def episodes(self) -> Iterator[tuple[int, Mapping[str, Any]]]:
        """Return each number with the values of its parameters, for `Instance.begin`."""
        if not self.values:
            return zip(self.numbers, itertools.repeat(NO_VALUES))
        pairs = (  # no step of Python's own for each number
            zip(itertools.repeat(name), values.copy() if values.ndim > 1 else values.tolist())
            for name, values in self.values.items()
        )
        return zip(self.numbers, map(dict, zip(*pairs, strict=True)), strict=True)

    def parameters(self, first: int, count: int) -> dict[str, Any]:
        """Return the parameters of some of the numbers as `EpisodeRecord` has them."""
        start = first - self.numbers.start
        which: Any = start if count == 1 else slice(start, start + count)
        return {name: values[which] for name, values in self.values.items()}
