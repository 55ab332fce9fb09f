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

    def __init__(
        self, uniform: float = 0.3, width: float = 0.1, memory: int = 512, delay: int = 1
    ) -> None:
        """Store the options.

        Args:
            uniform: Share of the sets that are drawn from the parameters' distributions.
            width: Half the width of the boxes, as a fraction of the parameters' ranges.
            memory: Number of most recent sets whose losses count.
            delay: See `LearningSampler`.

        Raises:
            ConfigError: If an option is out of range.
        """
        for name, value, low, high in (("uniform", uniform, 0, 1), ("width", width, 0, 0.5)):
            if not low < finite(f'"physx/active": {name}', value) <= high:
                raise ConfigError(f'"physx/active": {name} is {value!r}, not in ({low}, {high}].')
        for name, number, least in (("memory", memory, 1), ("delay", delay, 0)):
            if type(number) is not int or number < least:
                raise ConfigError(f'"physx/active": {name} is {number!r}, not at least {least}.')
        self.memory, self.delay = memory, delay
        self._uniform, self._width = float(uniform), float(width)

    def begin(self, parameters: Sequence[Parameter], seed: Sequence[int]) -> None:
        """Take the parameters: see `Sampler.begin`."""
        super().begin(parameters, seed)
        nothing = _Known(np.zeros(0, np.int64), np.zeros((0, self.size)), np.zeros(0))
        self._known: dict[int, _Known] = {0: nothing}
        self._weights: dict[int, Array] = {}

    def tell(
        self, batches: int, numbers: Index, values: Sequence[Mapping[str, Any]], losses: Array
    ) -> None:
        """Learn from a batch: see `LearningSampler.tell`. The latest loss of each set counts."""
        before = self._known[batches - 1]
        is_good = np.isfinite(losses)
        points = np.array([self._point(one) for one in values]).reshape(len(values), self.size)
        numbers, points, losses = numbers[is_good], points[is_good], losses[is_good]
        newest = max([*before.numbers[-1:], *numbers[-1:]], default=0)
        stays = ~np.isin(before.numbers, numbers) & (before.numbers > newest - self.memory)
        all_numbers = np.concatenate([before.numbers[stays], numbers])
        order = np.argsort(all_numbers)
        self._known[batches] = _Known(
            all_numbers[order],
            np.concatenate([before.points[stays], points])[order],
            np.concatenate([before.losses[stays], losses])[order],
        )
        for former in [known for known in self._known if known < batches - self.delay - 2]:
            del self._known[former]
            self._weights.pop(former, None)

    def ask_after(self, number: int, batches: int) -> dict[str, Any]:
        """Return the values of a set: see `LearningSampler.ask_after`."""
        random, known = self.random(number), self._known[batches]
        if random.random() < self._uniform or not len(known.numbers):
            return self.values(random.random(self.size))
        weights = self._weights_after(batches)
        center = known.points[np.searchsorted(weights, random.random(), side="right")]
        point = center + self._width * (2 * random.random(self.size) - 1)
        return self.values(1 - np.abs(1 - np.abs(point)))  # reflected at 0 and 1

    def state(self, batches: int) -> Array:
        """Return the known sets after the last batches: see `LearningSampler.state`."""
        kept = {
            n: one for n, one in self._known.items() if batches - self.delay - 1 <= n <= batches
        }
        parts = [
            np.concatenate([[n, len(one.losses)], one.numbers, one.losses, one.points.ravel()])
            for n, one in kept.items()
        ]
        return np.concatenate(parts)

    def restore(self, batches: int, state: Array) -> None:
        """Continue from a state: see `LearningSampler.restore`."""
        known: dict[int, _Known] = {}
        rest = np.asarray(state, np.float64)
        while len(rest):
            if (
                len(rest) < 2
                or not 0 <= rest[1] <= self.memory
                or rest[0] not in range(batches + 1)
            ):
                raise ValueError("it is the state of a sampler with other options")
            n, count = int(rest[0]), int(rest[1])
            end = 2 + count * (2 + self.size)
            if len(rest) < end:
                raise ValueError("it is the state of a sampler of other parameters")
            numbers, losses, points = np.split(rest[2:end], [count, 2 * count])
            known[n] = _Known(numbers.astype(np.int64), points.reshape(count, self.size), losses)
            rest = rest[end:]
        if batches not in known:
            raise ValueError("it is the state after other batches")
        self._known, self._weights = known, {}

    def _weights_after(self, batches: int) -> Array:
        """Return the cumulative probabilities of the known sets; the last one is 1."""
        if batches not in self._weights:
            known = self._known[batches]
            near = np.ones((len(known.numbers),) * 2, bool)
            for element in known.points.T:
                near &= np.abs(element[:, np.newaxis] - element) <= self._width
            lengths = np.minimum(known.points + self._width, 1) - np.maximum(
                known.points - self._width, 0
            )
            density = near.sum(1) / lengths.prod(1)
            weights = np.maximum(known.losses, 0) / density
            if not weights.any():
                weights = np.ones(len(weights))
            sums = np.cumsum(weights)
            self._weights[batches] = np.append(sums[:-1] / sums[-1], 1.0)
        return self._weights[batches]

    def _point(self, values: Mapping[str, Any]) -> Point:
        return np.concatenate([one.share(values[one.name]) for one in self.parameters])
