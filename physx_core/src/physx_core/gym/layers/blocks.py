"""What layers with a block have in common."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gymnasium import spaces

from physx_core.errors import ConfigError
from physx_core.gym.blocks.block import Block
from physx_core.gym.layer import Layer, PipelineEnv
from physx_core.interfaces.backend import Vector


class Rhythm:
    """When a block runs, at hand in one place: attributes of a layer take time to be looked up.

    Attributes:
        block: The block.
        acts: The next environment below that computes commands.
        observes: The next environment below that observes.
        stepper: Where the episode is.
        every: Period of the block, in physics steps.
        last: Physics step of the episode at which the block ran last; -1: not yet.
    """

    __slots__ = ("acts", "block", "every", "last", "observes", "stepper")

    def __init__(self, env: PipelineEnv, block: Any) -> None:
        self.block, self.stepper = block, env.stepper_state
        self.acts = _next_with("compute_command", env)
        self.observes = _next_with("refresh_observation", env)
        self.every, self.last = max(block.every, 1), -1


def _next_with(method: str, env: PipelineEnv) -> PipelineEnv:
    """Return the next environment, from this one down, that does more than to forward a method."""
    forwards = (getattr(Layer, method), getattr(BlockLayer, method))
    while isinstance(env, Layer) and getattr(type(env), method) in forwards:
        env = env.env
    return env


class BlockLayer(Layer):
    """A layer that runs a block at the block's own period.

    Attributes:
        block: The block.
    """

    block: Block

    def __init__(self, env: PipelineEnv, block: Block) -> None:
        """Put a block on the environment that it was made for.

        Raises:
            ConfigError: It was made for another one, or its name is taken.
        """
        if block.env is not env:
            raise ConfigError(
                f'The block "{block.name}" was made for {block.env!r}, not for {env!r}. '
                "Make a block and the layer that runs it for the same environment."
            )
        for below in env.layers:
            if isinstance(below, BlockLayer) and below.block.name == block.name:
                raise ConfigError(
                    f'The pipeline already has a block "{block.name}". Give each block a name of '
                    "its own."
                )
        self.block = block
        self._connected = env.simulator.builds
        self._made: tuple[Any, ...] = ()
        self._rhythm = Rhythm(env, block)
        super().__init__(env)

    def _initialize_action_space(self) -> None:
        """Let the block take up what changed in the simulator."""
        builds = self.env.simulator.builds
        if builds != self._connected:
            self.block.connect()
            self._connected = builds
        self._initialize_actions()

    def _initialize_actions(self) -> None:
        """Set `action_space` and `action`."""
        super()._initialize_action_space()

    def _initialize_observation_space(self) -> None:
        """Add the block's parts to the observation below, unless that is as it was."""
        basis = (self.env.observation_space, self.env.observation, self.action, self._connected)
        if len(self._made) == 4 and all(a is b for a, b in zip(self._made, basis, strict=True)):
            return
        self._made = basis
        super()._initialize_observation_space()
        self._add_parts()
        state, space = self.block.get_state(), self.block.state_space
        if state is not None and space is not None:
            self._add_part("states", space, state)
            self.register_variable("state", state, self.block.state_fieldnames, self.block.name)

    def _add_parts(self) -> None:
        """Add what is observed besides the block's state."""

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Let the layers below observe."""
        self._rhythm.observes.refresh_observation(measurement)

    def compute_command(self, action: Any, command: Vector) -> None:
        """Let the layers below compute the command of this layer's action."""
        self._rhythm.acts.compute_command(action, command)

    def _initialize_buffers(self) -> None:
        super()._initialize_buffers()
        self.block.setup()
        self.block.begin()
        self._rhythm = Rhythm(self.env, self.block)

    def _memory(self) -> Any:
        return {"block": self.block.snapshot(), "last": self._rhythm.last}

    def _recall(self, memory: Any) -> None:
        self.block.restore(memory["block"])
        self._rhythm.last = memory["last"]

    def _add_part(self, group: str, space: spaces.Space[Any], value: Any) -> None:
        """Add a part to the observation, under the block's name."""
        self.observation_space, self.observation = with_part(
            self.observation_space, self.observation, (group, self.block.name), space, value
        )


def with_part(
    space: spaces.Space[Any],
    observation: Any,
    keys: tuple[str, str],
    part_space: spaces.Space[Any],
    part: Any,
) -> tuple[spaces.Space[Any], Any]:
    """Return an observation space with one part more, and its buffer; the arrays stay the same.

    Args:
        space: Of the observation; one that is no dictionary goes under ``measurement``.
        observation: The buffer.
        keys: Where the part goes: the group and the name.
        part_space: Space of the part.
        part: Its buffer.
    """
    if not isinstance(space, spaces.Dict):
        space, observation = spaces.Dict({"measurement": space}), {"measurement": observation}
    group, name = keys
    inner = space.spaces.get(group, spaces.Dict({}))
    if not isinstance(inner, spaces.Dict) or name in inner.spaces:
        raise ConfigError(f'The observation has "{group}.{name}" already.')
    grown = spaces.Dict({**inner.spaces, name: part_space})
    parts = {**observation.get(group, {}), name: part}
    return spaces.Dict({**space.spaces, group: grown}), {**observation, group: parts}
