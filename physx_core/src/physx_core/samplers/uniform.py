"""Uniform: draws from the parameters' distributions."""

from __future__ import annotations

from typing import Any

from physx_core.components.parameter import draw
from physx_core.components.sampler import Sampler


class Uniform(Sampler):
    """Draws each set from the parameters' distributions, independently of all others."""

    def ask(self, number: int) -> dict[str, Any]:
        """Return the values of a set."""
        return draw(self.parameters, self.seed, number)
