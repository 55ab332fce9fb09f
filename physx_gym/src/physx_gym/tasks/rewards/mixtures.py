"""Rewards that are made of others."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from physx_core import checks
from physx_core.errors import ConfigError
from physx_gym.tasks.quantities import Quantities, Quantity
from physx_gym.tasks.rewards.reward import Reward


class _Mixture(Reward):
    """What sums and products share.

    Attributes:
        rewards: The parts.
        weights: Of each, as they are used.
    """

    def __init__(
        self,
        rewards: Sequence[Reward] | Mapping[Reward, float],
        name: str,
        weights: Sequence[float] | None,
        *,
        normalize: bool,
    ) -> None:
        super().__init__(name)
        weighted = _weighted(name, rewards, weights)
        if not weighted or not all(isinstance(each, Reward) for each in weighted):
            raise ConfigError(f'"{name}" needs rewards, not {list(weighted)}.')
        names = [part for each in weighted for part in each.names]
        if len(set(names)) < len(names):
            raise ConfigError(f'Two parts of "{name}" have one name: {sorted(names)}.')
        for each, weight in weighted.items():
            checks.finite(f'weight of "{each.name}"', weight)
        self.rewards = tuple(weighted)
        self.weights = tuple(weighted.values())
        if normalize:
            wrong = [each.name for each in self.rewards if not each.is_normalized]
            if wrong or min(self.weights) < 0 or sum(self.weights) <= 0:
                raise ConfigError(
                    f'"{name}" cannot be normalized: its parts must be, and have weights of at '
                    f"least 0. Not normalized: {wrong}; weights: {self.weights}."
                )
            total = sum(self.weights)
            self.weights = tuple(weight / total for weight in self.weights)
        self.is_normalized = normalize

    @property
    def watched(self) -> tuple[Quantity, ...]:
        """The quantities of all parts."""
        return tuple(quantity for each in self.rewards for quantity in each.watched)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of this reward and all parts."""
        return (self.name, *(name for each in self.rewards for name in each.names))

    def _parts(
        self, quantities: Quantities, terminated: bool, info: dict[str, float]
    ) -> list[float]:
        """Return the parts' rewards, and note them in the info."""
        found = []
        for each in self.rewards:
            value = each.compute(quantities, terminated, info)
            info[each.name] = value
            found.append(value)
        return found


def _weighted(name: str, rewards: Any, weights: Sequence[float] | None) -> dict[Any, float]:
    """Return the weight of each reward.

    Raises:
        ConfigError: There are weights for other rewards.
    """
    if weights is None:
        return dict(rewards) if isinstance(rewards, Mapping) else dict.fromkeys(rewards, 1.0)
    if isinstance(rewards, Mapping) or len(weights) != len(rewards):
        raise ConfigError(
            f'"{name}" has {len(rewards)} rewards and {len(weights)} weights: give a list of '
            "rewards and as many weights, or the weight of each reward."
        )
    return dict(zip(rewards, weights, strict=True))


class Sum(_Mixture):
    """The weighted sum of rewards."""

    def __init__(
        self,
        rewards: Sequence[Reward] | Mapping[Reward, float],
        name: str = "total",
        *,
        weights: Sequence[float] | None = None,
        normalize: bool = False,
    ) -> None:
        """Choose the parts.

        Args:
            rewards: Rewards, or the weight of each.
            name: Of the sum.
            weights: Of each of a list of rewards, as in a pipeline's file; None: 1.
            normalize: Divide by the sum of the weights; the sum is then within 0 and 1, as all of
                its parts must be.

        Raises:
            ConfigError: There are none, two have one name, or they cannot be normalized.
        """
        super().__init__(rewards, name, weights, normalize=normalize)

    def compute(self, quantities: Quantities, terminated: bool, info: dict[str, float]) -> float:
        """Return the sum."""
        parts = self._parts(quantities, terminated, info)
        return sum(weight * part for weight, part in zip(self.weights, parts, strict=True))


class Product(_Mixture):
    """The weighted geometric mean of rewards within 0 and 1: good only where all of them are."""

    def __init__(
        self,
        rewards: Sequence[Reward] | Mapping[Reward, float],
        name: str = "total",
        *,
        weights: Sequence[float] | None = None,
    ) -> None:
        """Choose the parts.

        Args:
            rewards: Normalized rewards, or the weight of each.
            name: Of the product.
            weights: Of each of a list of rewards, as in a pipeline's file; None: 1.

        Raises:
            ConfigError: There are none, two have one name, or one is not normalized.
        """
        super().__init__(rewards, name, weights, normalize=True)

    def compute(self, quantities: Quantities, terminated: bool, info: dict[str, float]) -> float:
        """Return the product."""
        parts = self._parts(quantities, terminated, info)
        pairs = zip(parts, self.weights, strict=True)
        return math.prod([float(part**weight) for part, weight in pairs if weight])
