"""Uniform: draws from the parameters' distributions."""

from __future__ import annotations

from typing import Any

from physx_core.components.parameter import draw, draw_many
from physx_core.components.sampler import Sampler


class Uniform(Sampler):
    """Draws each set from the parameters' distributions, independently of all others."""

    def ask(self, number: int) -> dict[str, Any]:
        """Return the values of a set."""
        return draw(self.parameters, self.seed, number)

    def ask_many(self, first: int, count: int) -> dict[str, Any]:
        """Return the values of consecutive sets."""
        return draw_many(self.parameters, self.seed, range(first, first + count))
