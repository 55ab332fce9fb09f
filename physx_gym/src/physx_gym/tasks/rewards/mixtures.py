"""Rewards that are composed of others."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from physx_core import checks
from physx_core.errors import ConfigError
from physx_gym.tasks.quantities import Quantities, Quantity
from physx_gym.tasks.rewards.reward import Reward


class _Mixture(Reward):
    """Base class of sums and products.

    Attributes:
        rewards: The parts.
        weights: Weights of the parts, normalized if requested.
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
            raise ConfigError(f'Two parts of "{name}" have the same name: {sorted(names)}.')
        self.rewards = tuple(weighted)
        self.weights = tuple(
            checks.finite(f'weight of "{each.name}"', weight) for each, weight in weighted.items()
        )
        if normalize:
            wrong = [each.name for each in self.rewards if not each.is_normalized]
            if wrong or min(self.weights) < 0 or sum(self.weights) <= 0:
                raise ConfigError(
                    f'"{name}" cannot be normalized: its parts must be normalized, with weights of '
                    f"at least 0. Not normalized: {wrong}; weights: {self.weights}."
                )
            total = sum(self.weights)
            self.weights = tuple(weight / total for weight in self.weights)
        self.is_normalized = normalize

    @property
    def watched(self) -> tuple[Quantity, ...]:
        """Quantities of all parts."""
        return tuple(quantity for each in self.rewards for quantity in each.watched)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the reward and all parts."""
        return (self.name, *(name for each in self.rewards for name in each.names))

    def _parts(
        self, quantities: Quantities, terminated: bool, info: dict[str, float]
    ) -> list[float]:
        """Return the rewards of the parts, and add them to the info."""
        found = []
        for each in self.rewards:
            value = each.compute(quantities, terminated, info)
            info[each.name] = value
            found.append(value)
        return found


def _weighted(name: str, rewards: Any, weights: Sequence[float] | None) -> dict[Any, float]:
    """Return the weight of each reward."""
    if weights is None:
        return dict(rewards) if isinstance(rewards, Mapping) else dict.fromkeys(rewards, 1.0)
    if isinstance(rewards, Mapping) or len(weights) != len(rewards):
        raise ConfigError(
            f'"{name}" has {len(rewards)} rewards and {len(weights)} weights: give a list of '
            "rewards and as many weights, or the weight of each reward."
        )
    return dict(zip(rewards, weights, strict=True))


class Sum(_Mixture):
    """Weighted sum of rewards."""

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
            name: Name of the sum.
            weights: Weights of a list of rewards, as in a pipeline's file; None: 1.
            normalize: Whether to divide by the sum of the weights; all parts must be normalized,
                and the result is then between 0 and 1 too.

        Raises:
            ConfigError: If there are no rewards, two have the same name, or they cannot be
                normalized.
        """
        super().__init__(rewards, name, weights, normalize=normalize)

    def compute(self, quantities: Quantities, terminated: bool, info: dict[str, float]) -> float:
        """Return the sum."""
        parts = self._parts(quantities, terminated, info)
        return sum(weight * part for weight, part in zip(self.weights, parts, strict=True))


class Product(_Mixture):
    """Weighted geometric mean of rewards between 0 and 1: high only if all of them are."""

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
            name: Name of the product.
            weights: Weights of a list of rewards, as in a pipeline's file; None: 1.

        Raises:
            ConfigError: If there are no rewards, two have the same name, or one is not normalized.
        """
        super().__init__(rewards, name, weights, normalize=True)

    def compute(self, quantities: Quantities, terminated: bool, info: dict[str, float]) -> float:
        """Return the weighted geometric mean."""
        parts = self._parts(quantities, terminated, info)
        pairs = zip(parts, self.weights, strict=True)
        return math.prod([float(part**weight) for part, weight in pairs if weight])
