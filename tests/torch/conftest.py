from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from physx_core import plugins


@pytest.fixture(autouse=True)
def one_thread_and_fixed_seed() -> Iterator[None]:
    threads, random = torch.get_num_threads(), torch.get_rng_state()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    yield
    torch.set_rng_state(random)
    torch.set_num_threads(threads)


@pytest.fixture
def build() -> Iterator[Callable[..., Any]]:
    """Return a function that builds a world's simulation; they are closed at the end."""
    made = []

    def build_one(world: Any, engine: str = "pinocchio") -> Any:
        made.append(plugins.resolve("backend", engine).build(world))
        return made[-1]

    yield build_one
    for simulation in made:
        simulation.close()


@pytest.fixture
def draw() -> Callable[..., tuple[torch.Tensor, ...]]:
    """Return a function that draws states with unit quaternions, and torques."""

    def drawn(simulation: Any, *leading: int) -> tuple[torch.Tensor, ...]:
        rng, layout = np.random.default_rng(4), simulation.layout
        q = rng.normal(size=(*leading, layout.nq))
        for part in layout.parts.values():
            if part.floating:
                base = slice(part.positions.start + 3, part.positions.start + 7)
                q[..., base] /= np.linalg.norm(q[..., base], axis=-1, keepdims=True)
        v, tau = rng.normal(size=(2, *leading, layout.nv))
        return tuple(torch.tensor(values, requires_grad=True) for values in (q, v, tau))

    return drawn
