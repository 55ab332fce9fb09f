"""Layers: environments on top of another one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.env.pipeline_env import Info, PipelineEnv, Step

if TYPE_CHECKING:
    from physx_gym.env.robot_env import RobotEnv

__all__ = ["Info", "Layer", "PipelineEnv", "Step"]


class Layer(PipelineEnv):
    """An environment on top of another one; it forwards what it does not override.

    Attributes that it does not have are those of the layer below. Subclasses with memory override
    `_memory` and `_recall`; those with an own action or observation set their space in
    `_initialize_action_space` or `_initialize_observation_space`, and the buffer there too.

    Attributes:
        env: The layer below.
    """

    def __init__(self, env: PipelineEnv) -> None:
        """Put a layer on an environment, and make it the top of the pipeline."""
        if not isinstance(env, PipelineEnv):
            raise ConfigError(
                f"{type(self).__name__} goes on a RobotEnv or a layer of one, not on {env!r}. "
                "Wrappers of gymnasium go around the whole pipeline."
            )
        self.env = env
        self._initialize_action_space()
        self._initialize_observation_space()
        env.unwrapped._update_pipeline(self)

    def __getattr__(self, name: str) -> Any:
        """Return a public attribute of the layer below."""
        if name.startswith("_") or "env" not in self.__dict__:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.env, name)

    @property
    def unwrapped(self) -> RobotEnv:
        """The base environment of the pipeline."""
        return self.env.unwrapped

    def _below(self) -> PipelineEnv:
        return self.env

    def _initialize_action_space(self) -> None:
        self.action_space, self.action = self.env.action_space, self.env.action

    def _initialize_observation_space(self) -> None:
        self.observation_space, self.observation = self.env.observation_space, self.env.observation

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Let the layer below observe."""
        self.env.refresh_observation(measurement)

    def compute_command(self, action: Any, command: Vector) -> None:
        """Let the layer below compute the command of this layer's action."""
        self.env.compute_command(action, command)

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return what the layer below says."""
        return self.env.has_terminated(info)

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward of the layers below."""
        return self.env.compute_reward(terminated, info)

    def _initialize_buffers(self) -> None:
        self.env._initialize_buffers()

    def _refresh_buffers(self) -> None:
        self.env._refresh_buffers()

    def stop(self) -> None:
        """End the episode; see `RobotEnv.stop`."""
        self.env.stop()

    def close(self) -> None:
        """Free what the environment holds; see `RobotEnv.close`."""
        self.env.close()

    def render(self) -> Any:
        """Return a picture; see `RobotEnv.render`."""
        return self.env.render()

    # What gymnasium gives every environment is the base's --------------------------------------

    @property
    def np_random(self) -> np.random.Generator:
        """What the environment draws from."""
        return self.env.np_random

    @np_random.setter
    def np_random(self, value: np.random.Generator) -> None:
        self.env.np_random = value

    @property
    def np_random_seed(self) -> int:
        """Seed of `np_random`."""
        return self.env.np_random_seed

    @property
    def render_mode(self) -> str | None:  # type: ignore[override]
        """How `render` shows the world."""
        return self.env.render_mode

    @property
    def metadata(self) -> dict[str, Any]:  # type: ignore[override]
        """What the environment can do."""
        return self.env.metadata

    @property
    def spec(self) -> Any:
        """How gymnasium's registry makes the environment, if it did."""
        return self.env.spec

    @spec.setter
    def spec(self, value: Any) -> None:
        self.env.spec = value

    # Pickling --------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes, and whether this is the top of the pipeline."""
        return super().__getstate__() | {"_is_top": self.derived is self}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take up the attributes, and the top of the pipeline."""
        is_top = state.pop("_is_top")
        super().__setstate__(state)
        if is_top:
            self.unwrapped.resume(self)
