"""What is drawn from the seed of an environment, apart from its states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from physx_gym.env.pipeline_env import PipelineEnv


def sensors_of(seed: int) -> np.random.SeedSequence:
    """Return what errors of sensors are drawn from."""
    return np.random.SeedSequence(seed, spawn_key=(1,))


def seed_spaces(layers: Sequence[PipelineEnv], seed: int, episode: int) -> None:
    """Let samples of the spaces be drawn anew.

    Args:
        layers: Environments with spaces.
        seed: The environment's; -1, where it is unknown: they are left as they are.
        episode: Number of episodes since the environment was seeded.
    """
    for i, layer in enumerate(layers if seed >= 0 else ()):
        for k, space in enumerate((layer.action_space, layer.observation_space)):
            key = (2, i, k, episode) if episode else (2, i, k)
            drawn = np.random.SeedSequence(seed, spawn_key=key).generate_state(1)
            space.seed(int(drawn[0]))
