"""Environments reduced to Gymnasium's interface."""

from __future__ import annotations

from typing import Any

import gymnasium

from physx_core.errors import ConfigError


class PlainEnv(gymnasium.Env[Any, Any]):
    """An environment with only the members of `gymnasium.Env`; see `plain`.

    Attributes:
        env: The environment.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        """Hide the other members of an environment."""
        self.env = env
        self.action_space, self.observation_space = env.action_space, env.observation_space
        self.metadata, self.render_mode, self.spec = env.metadata, env.render_mode, env.spec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment."""
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment."""
        return self.env.step(action)

    def render(self) -> Any:
        """Render the environment."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    @property
    def np_random(self) -> Any:
        """The environment's random generator."""
        return self.env.unwrapped.np_random

    @np_random.setter
    def np_random(self, value: Any) -> None:
        self.env.unwrapped.np_random = value

    @property
    def np_random_seed(self) -> int:
        """The environment's seed."""
        found: int = self.env.unwrapped.np_random_seed
        return found


def plain(env: gymnasium.Env[Any, Any]) -> PlainEnv:
    """Return an environment with only the members of `gymnasium.Env`.

    `PipelineEnv.compute_reward` has the name of a method of goal environments, but different
    parameters. Checks that recognize goal environments by that name alone, such as
    `stable_baselines3.common.env_checker.check_env`, pass with ``plain(env)``. Trainers do not need
    it.

    Args:
        env: An environment, with or without Gymnasium's wrappers.

    Raises:
        ConfigError: If it is not a Gymnasium environment.
    """
    if not isinstance(env, gymnasium.Env):
        raise ConfigError(f"plain needs a Gymnasium environment, not {env!r}.")
    return PlainEnv(env)
