"""Layers that run a block: observers and controllers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from gymnasium import spaces

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.blocks.block import ControllerBlock, ObserverBlock
from physx_gym.env.layers.layer import Layer
from physx_gym.env.pipeline_env import PipelineEnv
from physx_gym.spaces import neutral


class Schedule:
    """When a block runs, and what it calls; kept here because attributes of layers are slow.

    Attributes:
        run: Runs the block.
        act: `compute_command` of the next environment below that overrides it.
        observe: `refresh_observation` of the next environment below that overrides it.
        target: Action of the environment that `act` belongs to.
        stepper: Progress of the episode.
        every: Period of the block, in physics steps.
        last: Physics step of the episode at which the block last ran; -1: not yet.
    """

    __slots__ = ("act", "every", "last", "observe", "run", "stepper", "target")

    def __init__(self, env: PipelineEnv, block: ObserverBlock | ControllerBlock) -> None:
        acts = _next_with("compute_command", env)
        self.act, self.target = acts.compute_command, acts.action
        self.observe = _next_with("refresh_observation", env).refresh_observation
        self.run: Any = (
            block.refresh_observation if isinstance(block, ObserverBlock) else block.compute_command
        )
        self.stepper = env.stepper_state
        self.every, self.last = max(block.every, 1), -1


def _next_with(method: str, env: PipelineEnv) -> PipelineEnv:
    """Return the next environment, from this one down, that does not merely forward a method."""
    forwards = (getattr(Layer, method), getattr(BlockLayer, method))
    while isinstance(env, Layer) and getattr(type(env), method) in forwards:
        env = env.env
    return env


class BlockLayer(Layer):
    """A layer that runs a block at the block's own period.

    Attributes:
        block: The block.
    """

    constants: ClassVar[tuple[str, ...]] = (
        *("block", "observer", "controller", "augment_observation"),
        *("_basis", "_build", "_schedule"),
    )
    block: ObserverBlock | ControllerBlock

    def __init__(self, env: PipelineEnv, block: ObserverBlock | ControllerBlock) -> None:
        """Put a block on the environment that it was created for.

        Raises:
            ConfigError: If it was created for another environment, or its name is taken.
        """
        if block.env is not env:
            raise ConfigError(
                f'The block "{block.name}" was created for {block.env!r}, not for {env!r}. '
                "Create a block and the layer that runs it for the same environment."
            )
        for below in env.layers:
            if isinstance(below, BlockLayer) and below.block.name == block.name:
                raise ConfigError(
                    f'The pipeline already has a block "{block.name}". Give each block a different '
                    "name."
                )
        self.block = block
        self._basis: tuple[Any, ...] = ()
        self._build = -1
        self._schedule = Schedule(env, block)
        super().__init__(env)

    def _initialize_action_space(self) -> None:
        """Connect the block to the simulator, unless the simulator is unchanged."""
        self.block.refresh_connection()
        self._initialize_actions()

    def _initialize_actions(self) -> None:
        """Set `action_space` and `action`."""
        super()._initialize_action_space()

    def _initialize_observation_space(self) -> None:
        """Add the block's parts to the observation below, unless the latter is unchanged."""
        build = self.block.connected_to
        basis = (self.env.observation_space, self.env.observation, self.action)
        if build == self._build and all(a is b for a, b in zip(self._basis, basis, strict=True)):
            return
        self._basis, self._build = basis, build
        super()._initialize_observation_space()
        self._add_parts()
        state, space = self.block.get_state(), self.block.state_space
        if state is not None and space is not None:
            self._add_part("states", space, state)
            self.register_variable("state", state, self.block.state_fieldnames, self.block.name)

    def _add_parts(self) -> None:
        """Add the parts of the observation other than the block's state."""

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Update the observation of the layers below."""
        self._schedule.observe(measurement)

    def compute_command(self, action: Any, command: Vector) -> None:
        """Have the layers below compute the command for this layer's action."""
        self._schedule.act(action, command)

    def _initialize_buffers(self) -> None:
        super()._initialize_buffers()
        self.block.setup()
        self.block.begin()
        self._schedule = Schedule(self.env, self.block)

    def _memory(self) -> Any:
        return {"block": self.block.snapshot(), "last": self._schedule.last}

    def _recall(self, memory: Any) -> None:
        self.block.restore(memory["block"])
        self._schedule.last = memory["last"]

    def _add_part(self, group: str, space: spaces.Space[Any], value: Any) -> None:
        """Add a part to the observation, under the block's name."""
        self.observation_space, self.observation = add_part(
            self.observation_space, self.observation, (group, self.block.name), space, value
        )


class ObservedEnv(BlockLayer):
    """Adds an observer's features to the observation, as ``features.<block>``.

    The observer's state, if it has one, is added as ``states.<block>``.

    Attributes:
        observer: The block.
    """

    def __init__(self, env: PipelineEnv, observer: ObserverBlock) -> None:
        """Put an observer on the environment that it was created for.

        Raises:
            ConfigError: If it is not an observer, was created for another environment, or its name
                is taken.
        """
        if not isinstance(observer, ObserverBlock):
            raise ConfigError(f"ObservedEnv needs an ObserverBlock, not {observer!r}.")
        self.observer = observer
        super().__init__(env, observer)

    @property
    def observe_dt(self) -> float:  # type: ignore[override]
        """Time between two observations of the block, in s."""
        return self.observer.period or self.env.observe_dt

    def _add_parts(self) -> None:
        observer = self.observer
        self._add_part("features", observer.observation_space, observer.observation)
        self.register_variable("feature", observer.observation, observer.fieldnames, observer.name)

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Update the observation of the layers below, then run the block if it is due."""
        schedule = self._schedule
        schedule.observe(measurement)
        frame = schedule.stepper.iter
        if frame != schedule.last and frame % schedule.every == 0:
            schedule.last = frame
            schedule.run(measurement)


class ControlledEnv(BlockLayer):
    """Takes a controller's actions in place of those of the environment below.

    The controller's state, if it has one, is added to the observation as ``states.<block>``, and,
    with `augment_observation`, its action as ``actions.<block>``.

    Attributes:
        controller: The block.
        augment_observation: Whether the action is observed.
    """

    def __init__(
        self, env: PipelineEnv, controller: ControllerBlock, augment_observation: bool = False
    ) -> None:
        """Put a controller on the environment that it was created for.

        Raises:
            ConfigError: If it is not a controller, was created for another environment, or its name
                is taken.
        """
        if not isinstance(controller, ControllerBlock):
            raise ConfigError(f"ControlledEnv needs a ControllerBlock, not {controller!r}.")
        self.controller, self.augment_observation = controller, augment_observation
        super().__init__(env, controller)

    @property
    def control_dt(self) -> float:  # type: ignore[override]
        """Time between two commands of the block, in s."""
        return self.controller.period or self.env.control_dt

    def _initialize_actions(self) -> None:
        controller = self.controller
        if self._build >= 0 and self.action_space is controller.action_space:
            return
        self.action_space = controller.action_space
        self.action = neutral(self.action_space)
        self.register_variable("action", self.action, controller.fieldnames, controller.name)

    def _add_parts(self) -> None:
        if self.augment_observation:
            self._add_part("actions", self.action_space, self.action)

    def compute_command(self, action: Any, command: Vector) -> None:
        """Run the block if it is due, then have the layer below command the motors."""
        schedule = self._schedule
        target, frame = schedule.target, schedule.stepper.iter
        if frame != schedule.last and frame % schedule.every == 0:
            schedule.last = frame
            schedule.run(action, target)
        schedule.act(target, command)


def add_part(
    space: spaces.Space[Any],
    observation: Any,
    keys: tuple[str, str],
    part_space: spaces.Space[Any],
    part: Any,
) -> tuple[spaces.Space[Any], Any]:
    """Return an observation space and its buffer with a part added; the arrays stay the same.

    Args:
        space: Space of the observation; if it is not a dictionary, it goes under ``measurement``.
        observation: Its buffer.
        keys: Group and name of the part.
        part_space: Space of the part.
        part: Buffer of the part.
    """
    if not isinstance(space, spaces.Dict):
        space, observation = spaces.Dict({"measurement": space}), {"measurement": observation}
    group, name = keys
    inner = space.spaces.get(group, spaces.Dict({}))
    if not isinstance(inner, spaces.Dict) or name in inner.spaces:
        raise ConfigError(f'The observation already has "{group}.{name}".')
    grown = spaces.Dict({**inner.spaces, name: part_space})
    parts = {**observation.get(group, {}), name: part}
    return spaces.Dict({**space.spaces, group: grown}), {**observation, group: parts}
