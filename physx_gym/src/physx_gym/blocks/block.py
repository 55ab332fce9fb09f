"""Base classes of blocks, which observe or control inside the physics loop at their own period."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.env.pipeline_env import PipelineEnv
from physx_gym.shared_arrays import SharedArrays
from physx_gym.spaces import copy_tree, neutral
from physx_sim.errors import SimulationError


class Block(SharedArrays, ABC):
    """A part of a pipeline with its own period; a layer puts it on an environment.

    Subclasses create spaces and buffers in `connect`, compute in `setup` what depends on the
    periods, and begin an episode in `begin`. Attributes that hold state between calls are named in
    `memory`: arrays, which are kept and updated in place, or plain numbers and lists.

    Attributes:
        name: Name within the pipeline.
        env: The environment that the block is put on.
        update_ratio: Period in periods of the environment below; -1: one step of the environment.
        every: Period in physics steps; 0 before the first reset.
        period: The same in s.
        connected_to: Number of the simulator build that it is connected to; -1: none yet.
        memory: Names of the attributes that `snapshot` keeps.
    """

    memory: ClassVar[tuple[str, ...]] = ()

    def __init__(self, name: str, env: PipelineEnv, *, update_ratio: int = 1) -> None:
        """Create the block for an environment.

        Raises:
            ConfigError: If the name or the ratio is invalid.
        """
        if not isinstance(env, PipelineEnv):
            raise ConfigError(
                f"{type(self).__name__} needs a RobotEnv or a layer of one, not {env!r}."
            )
        if not isinstance(name, str) or not name or "." in name:
            raise ConfigError(f"The name of a block is {name!r} but must be a string without dots.")
        is_number = isinstance(update_ratio, (int, np.integer)) and not isinstance(
            update_ratio, bool
        )
        if not is_number or (update_ratio < 1 and update_ratio != -1):
            raise ConfigError(
                f'Block "{name}": update_ratio is {update_ratio!r} but must be a whole number of '
                "periods of the layer below, or -1 for one step of the environment."
            )
        self.name, self.env, self.update_ratio = name, env, int(update_ratio)
        self.every, self.period = 0, 0.0
        self.connected_to = -1

    def refresh_connection(self) -> None:
        """Call `connect` if the simulator has been rebuilt since the last time.

        Layers call this when they are created and at every reset; a constructor may too, so that
        spaces are known before there is a layer.
        """
        builds = self.env.simulator.builds
        if builds != self.connected_to:
            self.connect()
            self.connected_to = builds

    @abstractmethod
    def connect(self) -> None:
        """Create spaces and buffers that fit the environment.

        Called when a layer puts the block on its environment, and at a reset that changed the
        simulator's options, so limits and sensors may differ then.

        Raises:
            ConfigError: If the environment lacks what the block needs.
        """

    def setup(self) -> None:
        """Compute the periods; called at every reset, before `begin`.

        Raises:
            ConfigError: If the block's period does not divide a step of the environment.
        """
        physics = self.env.simulator.period
        step = round(self.env.step_dt / physics)
        every = step
        if self.update_ratio > 0:
            every = self.update_ratio * round(self._period_below() / physics)
        if step % every:
            raise ConfigError(
                f'Block "{self.name}": its period of {every * physics:g} s does not divide a step '
                f"of the environment, {self.env.step_dt:g} s. Change update_ratio."
            )
        self.every, self.period = every, every * physics

    @abstractmethod
    def _period_below(self) -> float:
        """Return the period of the environment below, in s."""

    def begin(self) -> None:
        """Begin an episode; the simulation is in its initial state, which has been measured."""

    @property
    def state_space(self) -> gymnasium.Space[Any] | None:
        """Space of `get_state`; None: the block does not have a state to observe."""
        return None

    def get_state(self) -> Any:
        """Return the state that is part of observations: an array, updated in place; or None."""
        return None

    @property
    def state_fieldnames(self) -> Any:
        """Names of the numbers of `get_state`, nested like it; None: they are numbered."""
        return None

    def snapshot(self) -> Any:
        """Return everything that `restore` needs to continue exactly from here, as plain data."""
        return {name: copy_tree(getattr(self, name)) for name in self.memory}

    def restore(self, state: Any) -> None:
        """Restore a snapshot of an identical block.

        Raises:
            SimulationError: If the snapshot is of a different block.
        """
        if not isinstance(state, Mapping) or set(state) != set(self.memory):
            raise SimulationError(f'The snapshot is not of the block "{self.name}".')
        for name in self.memory:
            own, given = getattr(self, name), state[name]
            if not isinstance(own, np.ndarray):
                setattr(self, name, copy_tree(given))
            elif np.shape(given) == own.shape:
                own[...] = given
            else:
                raise SimulationError(
                    f'The snapshot is not of the block "{self.name}": {name} has the shape '
                    f"{np.shape(given)}, not {own.shape}."
                )


class ObserverBlock(Block):
    """Computes features from the observations of the environment below.

    Attributes:
        observation_space: Space of the features.
        observation: The features, updated in place.
    """

    observation_space: gymnasium.Space[Any]
    observation: Any

    def _set_observation_space(self, space: gymnasium.Space[Any]) -> None:
        """Set the space of the features, and create their buffer."""
        self.observation_space, self.observation = space, neutral(space)

    def _period_below(self) -> float:
        return self.env.observe_dt

    @property
    def fieldnames(self) -> Any:
        """Names of the features' numbers, nested like `observation`; None: they are numbered."""
        return None

    @abstractmethod
    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Update `observation` in place; called once every period.

        Args:
            measurement: The latest measurement: ``t``, ``states``, ``measurements``.
        """


class ControllerBlock(Block):
    """Computes the action of the environment below from its own action.

    Attributes:
        action_space: Space of the block's own actions.
    """

    action_space: gymnasium.Space[Any]

    def _period_below(self) -> float:
        return self.env.control_dt

    @property
    def fieldnames(self) -> Any:
        """Names of the action's numbers, nested like it; None: they are numbered."""
        return None

    @abstractmethod
    def compute_command(self, action: Any, command: Vector) -> None:
        """Write the action of the environment below in place; called once every period.

        Args:
            action: The block's own action, within `action_space`.
            command: Action of the environment below.
        """
