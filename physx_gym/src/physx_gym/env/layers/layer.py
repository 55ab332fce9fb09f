"""Layers: environments on top of others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.env.pipeline_env import Info, PipelineEnv, Step
from physx_gym.env.robot_env import RobotEnv


def _property_of_base(name: str) -> property:
    """Return a property that is an attribute of the base environment."""

    def get(layer: Layer) -> Any:
        return getattr(layer._base, name)

    def change(layer: Layer, value: Any) -> None:
        setattr(layer._base, name, value)

    return property(get, change, doc=f"The base environment's `{name}`.")


class Layer(PipelineEnv):
    """An environment on top of another one; it forwards what it does not override.

    Attributes that it does not have are looked up in the layer below. Its own are in snapshots: see
    `PipelineEnv.snapshot`. Subclasses with their own action or observation set both the space and
    the buffer in `_initialize_action_space` or `_initialize_observation_space`.

    Attributes:
        env: The layer below.
    """

    constants: ClassVar[tuple[str, ...]] = (
        "env",
        "_base",
        "action_space",
        "action",
        "observation_space",
        "observation",
    )

    def __init__(self, env: PipelineEnv) -> None:
        """Put a layer on an environment, and make it the outermost of the pipeline.

        Raises:
            ConfigError: If `env` is neither a `RobotEnv` nor a layer of one.
        """
        if not isinstance(env, PipelineEnv):
            raise ConfigError(
                f"{type(self).__name__} goes on a RobotEnv or a layer of one, not on {env!r}. "
                "Gymnasium wrappers go around the whole pipeline."
            )
        self.env = env
        self._base: RobotEnv = env.unwrapped
        self._initialize_action_space()
        self._initialize_observation_space()
        self._base._update_pipeline(self)

    def __getattr__(self, name: str) -> Any:
        """Return a public attribute of the layer below."""
        if name.startswith("_") or "env" not in self.__dict__:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.env, name)

    def _initialize_action_space(self) -> None:
        self.action_space, self.action = self.env.action_space, self.env.action

    def _initialize_observation_space(self) -> None:
        self.observation_space, self.observation = self.env.observation_space, self.env.observation

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Update the observation of the layer below."""
        self.env.refresh_observation(measurement)

    def compute_command(self, action: Any, command: Vector) -> None:
        """Have the layer below compute the command for this layer's action."""
        self.env.compute_command(action, command)

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the layer below is terminated or truncated."""
        return self.env.has_terminated(info)

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward of the layers below."""
        return self.env.compute_reward(terminated, info)

    def _initialize_buffers(self) -> None:
        self.env._initialize_buffers()

    def _refresh_buffers(self) -> None:
        self.env._refresh_buffers()

    # The pipeline is run by its base -----------------------------------------------------------

    training: Any = _property_of_base("training")
    np_random: Any = _property_of_base("np_random")
    np_random_seed: Any = _property_of_base("np_random_seed")
    render_mode: Any = _property_of_base("render_mode")
    metadata: Any = _property_of_base("metadata")
    spec: Any = _property_of_base("spec")

    @property
    def unwrapped(self) -> RobotEnv:
        """The base environment of the pipeline."""
        return self._base

    @property
    def derived(self) -> PipelineEnv:
        """The outermost environment of the pipeline."""
        return self._base.derived

    @property
    def layers(self) -> tuple[PipelineEnv, ...]:
        """This environment and all below it, the base first."""
        return (*self.env.layers, self)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, Info]:
        """Start an episode with this layer as the outermost; see `PipelineEnv.reset`."""
        return self._base.run_reset(self, seed, options)

    def step(self, action: Any) -> Step:
        """Simulate `step_dt` under an action; see `PipelineEnv.step`."""
        return self._base.run_step(self, action)

    def restore(self, state: Any) -> None:
        """Restore a snapshot; see `PipelineEnv.restore`."""
        self._base.run_restore(self, state)

    def stop(self) -> None:
        """End the episode; see `RobotEnv.stop`."""
        self.env.stop()

    def close(self) -> None:
        """Free the environment's resources; see `RobotEnv.close`."""
        self.env.close()

    def render(self) -> Any:
        """Return a picture; see `RobotEnv.render`."""
        return self.env.render()

    def train(self, mode: bool = True) -> None:
        """Switch between training and evaluation; see `PipelineEnv.train`."""
        self._base.train(mode)

    # Pickling ----------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes, and whether this is the outermost layer."""
        return super().__getstate__() | {"_is_outermost": self.derived is self}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the attributes, and the outermost layer of the pipeline."""
        is_outermost = state.pop("_is_outermost")
        super().__setstate__(state)
        if is_outermost:
            self._base.adopt(self)
