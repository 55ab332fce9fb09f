"""Environments that have nothing but what Gymnasium's interface has."""

from __future__ import annotations

from typing import Any

import gymnasium

from physx_core.errors import ConfigError


class PlainEnv(gymnasium.Env[Any, Any]):
    """An environment without any members but those of `gymnasium.Env`; see `plain`.

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
    """Return an environment with nothing but the members of `gymnasium.Env`.

    `PipelineEnv.compute_reward` has the name of a method of goal environments, but other
    parameters. Checks that tell these environments by that name alone, such as
    `stable_baselines3.common.env_checker.check_env`, pass with ``plain(env)``. Trainers do not need
    it.

    Args:
        env: An environment, with or without Gymnasium's wrappers.

    Raises:
        ConfigError: If it is not an environment of Gymnasium.
    """
    if not isinstance(env, gymnasium.Env):
        raise ConfigError(f"plain needs an environment of Gymnasium, not {env!r}.")
    return PlainEnv(env)
