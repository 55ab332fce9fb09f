"""What the base environment and every layer of a pipeline have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from physx_gym.shared_arrays import SharedArrays
from physx_gym.spaces import copy_tree, fill

if TYPE_CHECKING:
    from physx_core.simulation import Part
    from physx_core.typing import Vector
    from physx_gym.env.robot_env import RobotEnv
    from physx_gym.simulator.simulator import Simulator
    from physx_gym.simulator.states import RobotState, StepperState

Info = dict[str, Any]
Step = tuple[Any, float, bool, bool, Info]


class PipelineEnv(SharedArrays, gymnasium.Env[Any, Any], ABC):
    """A robot environment: `RobotEnv` alone, or with layers on it.

    The buffers `observation` and `action`, and all other arrays here, stay the same objects and are
    updated in place; `reset` and `step` return copies.

    Attributes:
        observation: What this layer observed last.
        action: What this layer was told last, within the action space.
        simulator: The world, its motors and sensors.
        robot: Place of the robot that acts in the simulation's state.
        robot_state: State of the robot that acts.
        stepper_state: Time and physics steps of the episode.
        is_simulation_running: Whether an episode runs; shape ().
        num_steps: Steps since the last reset; -1 before the first; shape ().
        measurements: What the simulation measured last: ``t``, ``states``, ``measurements``.
        quantities: Values that rewards and terminations share, computed at most once a step.
        simulation_duration_max: Time, in s, after which an episode is truncated.
        debug: Whether every physics step is recorded.
        reset_options: The options that `reset` was given.
        viewer_kwargs: Options of the viewer.
        step_dt: Time of a step, in s.
        control_dt: Time between two commands, in s; of a layer, between two of its own.
        observe_dt: Time between two observations within a step, likewise.
    """

    observation: Any
    action: Any
    simulator: Simulator
    robot: Part
    robot_state: RobotState
    stepper_state: StepperState
    is_simulation_running: NDArray[np.bool_]
    num_steps: NDArray[np.int64]
    measurements: dict[str, Any]
    quantities: Any
    simulation_duration_max: float
    debug: bool
    reset_options: dict[str, Any]
    viewer_kwargs: dict[str, Any]
    step_dt: float
    control_dt: float
    observe_dt: float

    # What a layer may override ---------------------------------------------------------------

    @abstractmethod
    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Bring `observation` to the present, in place.

        Called every `observe_dt` and at the end of each step and reset.

        Args:
            measurement: What was measured: ``t``, ``states``, ``measurements``.
        """

    @abstractmethod
    def compute_command(self, action: Any, command: Vector) -> None:
        """Write the command of the layer below, or of the motors, in place.

        Called every `control_dt`.

        Args:
            action: What this layer shall do: its own `action`.
            command: Torques of the motors, shape (motors,), in N m or N.
        """

    @abstractmethod
    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the episode terminated, and whether it is truncated.

        Args:
            info: Of this step; to be added to.
        """

    @abstractmethod
    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward of this step, of this layer and all below.

        Args:
            terminated: Whether this step ended the task.
            info: Of this step; to be added to.
        """

    def _setup(self) -> None:
        """Configure for the episode that begins, before its first state is known.

        Called at every reset: the base environment's first, then each layer's from below.
        """

    @abstractmethod
    def _initialize_action_space(self) -> None:
        """Set `action_space`."""

    @abstractmethod
    def _initialize_observation_space(self) -> None:
        """Set `observation_space`."""

    @abstractmethod
    def _initialize_buffers(self) -> None:
        """Prepare for the episode: it runs, but nothing was observed yet."""

    @abstractmethod
    def _refresh_buffers(self) -> None:
        """Bring to the present what termination and reward share; called once a step."""

    # The pipeline ----------------------------------------------------------------------------

    @property
    @abstractmethod
    def unwrapped(self) -> RobotEnv:
        """The base environment of the pipeline."""

    @property
    def derived(self) -> PipelineEnv:
        """The topmost layer of the pipeline that this environment is part of."""
        return self.unwrapped.derived

    @property
    def layers(self) -> tuple[PipelineEnv, ...]:
        """This environment and all below it, the base first."""
        found: list[PipelineEnv] = []
        layer: PipelineEnv | None = self
        while layer is not None:
            found.append(layer)
            layer = layer._below()
        return tuple(reversed(found))

    def _below(self) -> PipelineEnv | None:
        """Return the layer below; None: this is the base."""
        return None

    def has_wrapper_attr(self, name: str) -> bool:
        """Return whether this environment or one below has an attribute."""
        return hasattr(self, name)

    def get_wrapper_attr(self, name: str) -> Any:
        """Return an attribute of this environment, or of the first below that has it.

        Raises:
            AttributeError: None has it.
        """
        return getattr(self, name)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """Set an attribute on the first environment that has it, from this one to the base.

        Args:
            name: Name of the attribute.
            value: Its value.
            force: Where none has it: whether to add it to this one.

        Returns:
            Whether it was set.
        """
        for layer in reversed(self.layers):
            if name in vars(layer) or _is_own(type(layer), name):
                setattr(layer, name, value)
                return True
        if force:
            setattr(self, name, value)
        return force

    @property
    def log_fieldnames(self) -> Mapping[str, Any]:
        """Names of the recorded numbers of every registered variable, of all layers."""
        return self.unwrapped.recording.telemetry.fieldnames

    # Running ---------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, Info]:
        """Begin an episode with this environment as the top of its pipeline.

        Args:
            seed: Of everything that is drawn from now on; None: go on with what is there.
            options: For `_setup` of all layers, which find them in `reset_options`.

        Returns:
            The first observation, and information.

        Raises:
            EpisodeError: The first state ends the episode already.
            ConfigError: Periods do not fit together.
            SimulationError: The first state makes no sense.
        """
        return self.unwrapped.run_reset(self, seed, options)

    def step(self, action: Any) -> Step:
        """Simulate `step_dt` under an action.

        Args:
            action: Brought into the bounds of the action space before anything sees it.

        Returns:
            Observation, reward, whether the episode terminated, whether it is truncated, and
            information.

        Raises:
            EpisodeError: No episode runs, it is over, or another layer began it.
            ActionError: The action has another form than the action space, or is not a number.
            SimulationError: The simulation, an observation or a reward is no longer finite.
        """
        return self.unwrapped.run_step(self, action)

    def evaluate(
        self,
        policy_fn: Any,
        seed: int | None = None,
        horizon: float | None = None,
        enable_stats: bool = True,
        enable_replay: bool | None = None,
        **kwargs: Any,
    ) -> tuple[list[float], list[Info]]:
        """Run an episode in evaluation mode; see `physx_gym.show.evaluating.evaluate`."""
        from physx_gym.show.evaluating import evaluate

        return evaluate(self, policy_fn, seed, horizon, enable_stats, enable_replay, **kwargs)

    def play_interactive(
        self,
        enable_travelling: bool | None = None,
        start_paused: bool = True,
        enable_is_done: bool = True,
        verbose: bool = True,
        **kwargs: Any,
    ) -> None:
        """Play with the keyboard; see `physx_gym.show.interactive.play`."""
        from physx_gym.show.interactive import play

        play(self, enable_travelling, start_paused, enable_is_done, verbose, **kwargs)

    @abstractmethod
    def stop(self) -> None:
        """End the episode; what was recorded is written. To go on, call `reset`."""

    # State -----------------------------------------------------------------------------------

    def snapshot(self) -> Any:
        """Return everything that `restore` needs to go on exactly from here; plain data.

        It holds the simulation, all draws, and every layer up to this one.
        """
        layers = self.layers
        return {
            "layers": [type(layer).__name__ for layer in layers],
            "own": [layer._snapshot_own() for layer in layers],
        }

    def restore(self, state: Any) -> None:
        """Go back to a snapshot of this environment, or of one that is built alike.

        Raises:
            SimulationError: It is of another environment.
        """
        self.unwrapped.run_restore(self, state)

    def _memory(self) -> Any:
        """Return what this layer alone remembers, as plain data; None: nothing.

        To be overridden, with `_recall`, where attributes live from one step to the next.
        """
        return None

    def _recall(self, memory: Any) -> None:
        """Take up what `_memory` returned."""

    def _snapshot_own(self) -> dict[str, Any]:
        return {
            "action": copy_tree(self.action),
            "observation": copy_tree(self.observation),
            "memory": copy_tree(self._memory()),
        }

    def _restore_own(self, own: dict[str, Any]) -> None:
        self.action = fill(self.action, own["action"])
        self.observation = fill(self.observation, own["observation"])
        self._recall(copy_tree(own["memory"]))


def _is_own(kind: type, name: str) -> bool:
    """Return whether a class below `PipelineEnv` has an attribute that can be set."""
    for each in kind.__mro__:
        if each in (PipelineEnv, SharedArrays, gymnasium.Env, object):
            return False
        if name in vars(each):
            value = vars(each)[name]
            return not isinstance(value, property) or value.fset is not None
    return False
