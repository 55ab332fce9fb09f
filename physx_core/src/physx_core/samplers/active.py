"""Active: draws more sets where the network's loss is high."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from physx_core.checks import finite
from physx_core.components.parameter import Parameter, Point
from physx_core.components.sampler import LearningSampler
from physx_core.errors import ConfigError
from physx_core.typing import Array, Index


class _Known(NamedTuple):
    """The sets with known losses: numbers (n,), points (n, size), losses (n,)."""

    numbers: Index
    points: Array
    losses: Array


class Active(LearningSampler):
    """Draws sets near known ones with a high loss, and a share of them from the distributions.

    A known set is picked with a probability proportional to its loss divided by the density of
    known sets around it, so how often a region is simulated depends on the loss there, not on how
    often it was simulated before (adaptive importance sampling). The new set is drawn from a box
    around it. All this happens in the unit cube, where the parameters' distributions are uniform.
    """

    def __init__(self, uniform: float = 0.3, width: float = 0.1, memory: int = 512) -> None:
        """Store the options.

        Args:
            uniform: Share of the sets that are drawn from the parameters' distributions.
            width: Half the width of the boxes, as a fraction of the parameters' ranges.
            memory: Number of most recent sets whose losses count.

        Raises:
            ConfigError: If an option is out of range.
        """
        for name, value, low, high in (("uniform", uniform, 0, 1), ("width", width, 0, 0.5)):
            if not low < finite(f'"physx/active": {name}', value) <= high:
                raise ConfigError(f'"physx/active": {name} is {value!r}, not in ({low}, {high}].')
        if type(memory) is not int or memory < 1:
            raise ConfigError(f'"physx/active": memory is {memory!r}, not at least 1.')
        self.memory = memory
        self._uniform, self._width = float(uniform), float(width)

    def begin(self, parameters: Sequence[Parameter], seed: Sequence[int]) -> None:
        """Take the parameters: see `Sampler.begin`."""
        super().begin(parameters, seed)
        self._known = _Known(np.zeros(0, np.int64), np.zeros((0, self.size)), np.zeros(0))
        self._weights: Array | None = None

    def tell(self, numbers: Index, values: Sequence[Mapping[str, Any]], losses: Array) -> None:
        """Learn from a batch: see `LearningSampler.tell`. The latest loss of each set counts."""
        before, is_good = self._known, np.isfinite(losses)
        points = np.array([self._point(one) for one in values]).reshape(len(values), self.size)
        numbers, points, losses = numbers[is_good], points[is_good], losses[is_good]
        newest = max([*before.numbers[-1:], *numbers[-1:]], default=0)
        stays = ~np.isin(before.numbers, numbers) & (before.numbers > newest - self.memory)
        all_numbers = np.concatenate([before.numbers[stays], numbers])
        order = np.argsort(all_numbers)
        self._known = _Known(
            all_numbers[order],
            np.concatenate([before.points[stays], points])[order],
            np.concatenate([before.losses[stays], losses])[order],
        )
        self._weights = None

    def ask(self, number: int) -> dict[str, Any]:
        """Return the values of a set: see `LearningSampler.ask`."""
        random, known = self.random(number), self._known
        if random.random() < self._uniform or not len(known.numbers):
            return self.values(random.random(self.size))
        if self._weights is None:
            self._weights = self._weigh(known)
        center = known.points[np.searchsorted(self._weights, random.random(), side="right")]
        point = center + self._width * (2 * random.random(self.size) - 1)
        return self.values(1 - np.abs(1 - np.abs(point)))  # reflected at 0 and 1

    def state(self) -> Array:
        """Return the known sets: see `LearningSampler.state`."""
        known = self._known
        return np.concatenate([known.numbers, known.losses, known.points.ravel()])

    def restore(self, state: Array) -> None:
        """Continue from a state: see `LearningSampler.restore`."""
        count, rest = divmod(len(state), 2 + self.size)
        if rest or count > self.memory:
            raise ValueError("it is the state of a sampler with other options or parameters")
        numbers, losses, points = np.split(np.asarray(state, np.float64), [count, 2 * count])
        if not (np.diff(numbers) > 0).all() or (points < 0).any() or (points > 1).any():
            raise ValueError("it is the state of another sampler")
        self._known = _Known(numbers.astype(np.int64), points.reshape(count, self.size), losses)
        self._weights = None

    def _weigh(self, known: _Known) -> Array:
        """Return the cumulative probabilities of the known sets; the last one is 1."""
        near = np.ones((len(known.numbers),) * 2, bool)
        for element in known.points.T:
            near &= np.abs(element[:, np.newaxis] - element) <= self._width
        upper, lower = known.points + self._width, known.points - self._width
        density = near.sum(1) / (np.minimum(upper, 1) - np.maximum(lower, 0)).prod(1)
        weights = np.maximum(known.losses, 0) / density
        if not weights.any():
            weights = np.ones(len(weights))
        sums = np.cumsum(weights)
        return np.append(sums[:-1] / sums[-1], 1.0)

    def _point(self, values: Mapping[str, Any]) -> Point:
        return np.concatenate([one.share(values[one.name]) for one in self.parameters])
