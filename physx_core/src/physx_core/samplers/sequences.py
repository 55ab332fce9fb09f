"""Sobol and LatinHypercube: sets that fill the space of parameters evenly."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from physx_core.components.parameter import Parameter
from physx_core.components.sampler import Sampler
from physx_core.errors import ConfigError, MissingLibraryError
from physx_core.typing import Array

_BLOCK = 1024
_LONGEST = 2**30  # of a Sobol sequence
_KEPT = 4


class _Blocks(Sampler):
    """Sets that are computed a block at a time; the last few blocks are kept."""

    block: int

    def begin(self, parameters: Sequence[Parameter], seed: Sequence[int]) -> None:
        """Take the parameters: see `Sampler.begin`."""
        super().begin(parameters, seed)
        self._blocks: dict[int, Array] = {}

    def ask(self, number: int) -> dict[str, Any]:
        """Return the values of a set."""
        index, place = divmod(number, self.block)
        return self.values(self._block(index)[place])

    def ask_many(self, first: int, count: int) -> dict[str, Any]:
        """Return the values of consecutive sets."""
        end = first + count
        indexes = range(first // self.block, (end - 1) // self.block + 1)
        points = np.concatenate([self._block(index) for index in indexes])
        begin = indexes[0] * self.block
        return self.values(points[first - begin : end - begin])

    def _block(self, index: int) -> Array:
        if index not in self._blocks:
            while len(self._blocks) >= _KEPT:
                del self._blocks[min(self._blocks)]
            self._blocks[index] = self._points(index)
        return self._blocks[index]

    @abstractmethod
    def _points(self, index: int) -> Array:
        """Return the points of a block, shape (block, size)."""


class Sobol(_Blocks):
    """A scrambled Sobol sequence: any number of sets fills the space more evenly than random ones.

    Uses `scipy.stats.qmc.Sobol`. The sets are most even if their number is a power of two.
    """

    block = _BLOCK

    def begin(self, parameters: Sequence[Parameter], seed: Sequence[int]) -> None:
        """Take the parameters: see `Sampler.begin`."""
        super().begin(parameters, seed)
        self._engine: Any = None  # goes on where the last block ended
        most = _qmc().Sobol.MAXDIM
        if self.size > most:
            raise ConfigError(
                f'"physx/sobol" chooses at most {most} numbers, but the environment\'s parameters '
                f'have {self.size} elements: use "physx/uniform".'
            )

    def _points(self, index: int) -> Array:
        first = index * _BLOCK % _LONGEST
        if self._engine is None or self._engine.num_generated > first:
            self._engine = _qmc().Sobol(self.size, scramble=True, rng=self.random(0))
        ahead = first - self._engine.num_generated
        if ahead:  # it does not accept 0
            self._engine.fast_forward(ahead)
        points: Array = self._engine.random(_BLOCK)
        return points


class LatinHypercube(_Blocks):
    """Latin hypercubes: of every `points` sets, each of a parameter's `points` intervals has one.

    Uses `scipy.stats.qmc.LatinHypercube`.
    """

    def __init__(self, points: int = 100) -> None:
        """Store the size.

        Args:
            points: Number of sets in a hypercube; then the next one begins.
        """
        if type(points) is not int or points < 1:
            raise ConfigError(f'"physx/latin_hypercube": points is {points!r}, not at least 1.')
        self.block = points

    def begin(self, parameters: Sequence[Parameter], seed: Sequence[int]) -> None:
        """Take the parameters: see `Sampler.begin`."""
        super().begin(parameters, seed)
        _qmc()  # raises for a missing library before anything is simulated

    def _points(self, index: int) -> Array:
        engine = _qmc().LatinHypercube(self.size, rng=self.random(index))
        points: Array = np.asarray(engine.random(self.block))
        return points


def _qmc() -> Any:
    try:
        from scipy.stats import qmc
    except ImportError as error:
        raise MissingLibraryError("This sampler", "scipy", "samplers") from error
    return qmc
