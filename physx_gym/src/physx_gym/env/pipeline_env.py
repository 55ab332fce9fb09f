"""The interface shared by a pipeline's base environment and every layer on it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from physx_core.typing import Vector
from physx_gym.env import own_state
from physx_gym.shared_arrays import SharedArrays
from physx_gym.simulator.simulator import Simulator
from physx_gym.simulator.states import RobotState, StepperState
from physx_gym.spaces import copy_tree, fill
from physx_gym.telemetry.episode_recorder import EpisodeRecorder
from physx_sim import Part

Info = dict[str, Any]
Step = tuple[Any, float, bool, bool, Info]


class PipelineEnv(SharedArrays, gymnasium.Env[Any, Any], ABC):
    """A robot environment: `RobotEnv` alone, or with layers on it.

    The buffers `observation` and `action`, and all other arrays here, stay the same objects and are
    updated in place; `reset` and `step` return copies.

    Attributes:
        observation: The latest observation of this layer.
        action: The latest action of this layer, within the action space.
        simulator: The world, its motors and sensors.
        robot: The controlled robot's part of the simulation's state.
        robot_state: State of the controlled robot.
        stepper_state: Time and physics steps of the episode.
        is_simulation_running: Whether an episode is running; shape ().
        num_steps: Steps since the last reset; -1 before the first; shape ().
        measurements: The latest measurement: ``t``, ``states``, ``measurements``.
        quantities: Values that rewards and terminations share, computed at most once a step.
        recorder: Records episodes.
        simulation_duration_max: Time, in s, after which an episode is truncated.
        debug: Whether every physics step is recorded.
        reset_options: The options passed to `reset`.
        viewer_kwargs: Options of the viewer.
        step_dt: Duration of a step, in s.
        control_dt: Time between two commands, in s; for a layer, between two of its own.
        observe_dt: Time between two observations within a step, in s; likewise.
    """

    constants: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes of this class that snapshots leave out: they never change during an
    episode, or `_memory` has them. A subclass names only its own."""

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
    recorder: EpisodeRecorder
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
        """Update `observation` in place.

        Called every `observe_dt` and at the end of each step and reset.

        Args:
            measurement: The latest measurement: ``t``, ``states``, ``measurements``.
        """

    @abstractmethod
    def compute_command(self, action: Any, command: Vector) -> None:
        """Compute the torques of the motors for an action, and write them in place.

        Called every `control_dt`. A layer that changes the action writes that of the environment
        below into ``env.action``, and has it compute the torques.

        Args:
            action: The action of this layer.
            command: Torques of the motors, shape (motors,), in N m or N, for every layer.
        """

    @abstractmethod
    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the episode is terminated, and whether it is truncated.

        Args:
            info: Information of this step, to be extended.
        """

    @abstractmethod
    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward of this step, from this layer and all below.

        Args:
            terminated: Whether this step terminated the episode.
            info: Information of this step, to be extended.
        """

    def _setup(self) -> None:
        """Configure the next episode, before its initial state is known.

        Called at every reset: the base environment's first, then each layer's, from the bottom up.
        """

    @abstractmethod
    def _initialize_action_space(self) -> None:
        """Set `action_space`."""

    @abstractmethod
    def _initialize_observation_space(self) -> None:
        """Set `observation_space`."""

    @abstractmethod
    def _initialize_buffers(self) -> None:
        """Prepare for the episode: the simulation is running, but nothing has been observed."""

    @abstractmethod
    def _refresh_buffers(self) -> None:
        """Update what terminations and rewards share; called once a step."""

    # The pipeline ----------------------------------------------------------------------------

    @property
    @abstractmethod
    def unwrapped(self) -> Any:
        """The base environment of the pipeline, a `RobotEnv`."""

    @property
    @abstractmethod
    def derived(self) -> PipelineEnv:
        """The outermost environment of this environment's pipeline."""

    @property
    @abstractmethod
    def layers(self) -> tuple[PipelineEnv, ...]:
        """This environment and all below it, the base first."""

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """Set an attribute on the first environment that has it, from this one down to the base.

        Args:
            name: Name of the attribute.
            value: Its value.
            force: Whether to add it to this environment if none has it.

        Returns:
            Whether it was set.
        """
        for layer in reversed(self.layers):
            if name in vars(layer) or _defines(type(layer), name):
                setattr(layer, name, value)
                return True
        if force:
            setattr(self, name, value)
        return force

    # Running ---------------------------------------------------------------------------------

    @abstractmethod
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, Info]:
        """Start an episode with this environment as the outermost of its pipeline.

        Args:
            seed: Seed of all randomness from now on; None: continue the sequence.
            options: For `_setup` of all layers, which can read them from `reset_options`.

        Returns:
            The first observation, and information.

        Raises:
            EpisodeError: If the initial state already ends the episode.
            ConfigError: If the options are not a mapping, or the periods are incompatible.
            SimulationError: If the initial state is invalid.
        """

    @abstractmethod
    def step(self, action: Any) -> Step:
        """Simulate `step_dt` under an action.

        Args:
            action: The action; clipped to the bounds of the action space before any use.

        Returns:
            Observation, reward, whether the episode is terminated, whether it is truncated, and
            information.

        Raises:
            EpisodeError: If no episode is running, it is over, or another layer started it.
            ActionError: If the action does not have the form of the action space, or is not finite.
            SimulationError: If the simulation, an observation or a reward is no longer finite.
            ConfigError: If the information has a name of trainers: see `OF_TRAINERS`.
        """

    @abstractmethod
    def stop(self) -> None:
        """End the episode and write its recording. Call `reset` to start the next."""

    @property
    @abstractmethod
    def training(self) -> bool:
        """Whether the mode is training; otherwise it is evaluation, which records episodes."""

    @abstractmethod
    def train(self, mode: bool = True) -> None:
        """Switch between training and evaluation.

        Raises:
            EpisodeError: If an episode is running.
        """

    def eval(self) -> None:
        """Switch to evaluation; see `train`."""
        self.train(False)

    def evaluate(
        self,
        policy_fn: Any,
        seed: int | None = None,
        horizon: float | None = None,
        enable_stats: bool = True,
        enable_replay: bool | None = None,
        **kwargs: Any,
    ) -> tuple[list[float], list[Info]]:
        """Run an episode in evaluation mode; see `physx_gym.visualization.evaluating.evaluate`."""
        from physx_gym.visualization.evaluating import evaluate

        return evaluate(self, policy_fn, seed, horizon, enable_stats, enable_replay, **kwargs)

    def play_interactive(
        self,
        enable_travelling: bool | None = None,
        start_paused: bool = True,
        enable_is_done: bool = True,
        verbose: bool = True,
        **kwargs: Any,
    ) -> None:
        """Play using the keyboard; see `physx_gym.visualization.interactive.play`."""
        from physx_gym.visualization.interactive import play

        play(self, enable_travelling, start_paused, enable_is_done, verbose, **kwargs)

    # Recording -------------------------------------------------------------------------------

    def register_variable(
        self,
        name: str,
        value: Any,
        fieldnames: str | Mapping[str, Any] | Sequence[Any] | None = None,
        namespace: str | None = None,
        *,
        is_eval_only: bool = True,
    ) -> None:
        """Record arrays from the next reset on.

        Args:
            name: Name of the variable; the names of its columns begin with it.
            value: An array of float64 or int64, or nested containers of them. They are read
                whenever a row is recorded, so keep them and update them in place.
            fieldnames: Names of all numbers, nested like the value; None: numbered.
            namespace: Prefix of the name; None: none.
            is_eval_only: Whether to record it in evaluation only.

        Raises:
            EpisodeError: If an episode is running in evaluation.
            ConfigError: If the value or its names are invalid, or a name is already used.
        """
        self.recorder.telemetry.register(
            name, value, fieldnames, namespace, is_eval_only=is_eval_only
        )

    @property
    def log_fieldnames(self) -> Mapping[str, Any]:
        """Names of the recorded numbers of every registered variable, of all layers."""
        return self.recorder.telemetry.fieldnames

    @property
    def log_data(self) -> dict[str, Any]:
        """The recording of the running episode so far, or of the last one.

        In training, that is the state and the sensors' measurements, once a step; in evaluation,
        everything, at every command and observation.

        Returns:
            A dictionary of ``"constants"`` and ``"variables"``, columns by name; empty before the
            first episode.
        """
        return self.recorder.data()

    def plot(self, enable_block_states: bool = False, **kwargs: Any) -> Any:
        """Plot the running episode, or the last one; see `physx_gym.visualization.plotting.plot`.

        Args:
            enable_block_states: Whether to show the states of blocks too.
            kwargs: For `physx_gym.visualization.plotting.plot`.
        """
        from physx_gym.visualization.plotting import plot

        return plot(self.log_data, enable_block_states=enable_block_states, **kwargs)

    def replay(self, **kwargs: Any) -> Any:
        """Show the running episode, or the last one; see `physx_gym.replay`."""
        from physx_gym.visualization.replaying import replay

        return replay(self.log_data, **kwargs)

    # State -----------------------------------------------------------------------------------

    def snapshot(self) -> Any:
        """Return everything that `restore` needs to continue exactly from here.

        It contains the simulation, all random generators, and every layer up to this one, with the
        attributes that subclasses have added: arrays, numbers, random generators, containers and
        objects of these, but for those named in `constants`. It can be pickled if they can.

        Raises:
            SimulationError: If an attribute cannot be copied, such as a file or a generator.
        """
        layers = self.layers
        return {
            "layers": [type(layer).__name__ for layer in layers],
            "own": [layer._snapshot_own() for layer in layers],
        }

    @abstractmethod
    def restore(self, state: Any) -> None:
        """Restore a snapshot of this environment, or of one that is built identically.

        Raises:
            SimulationError: If the snapshot is of a different environment.
        """

    def _memory(self) -> Any:
        """Return what this layer keeps from one step to the next besides its attributes.

        Override it together with `_recall` for state that is not in attributes, or in attributes
        that cannot be copied, which `constants` names; None: nothing.
        """
        return None

    def _recall(self, memory: Any) -> None:
        """Restore what `_memory` returned."""

    def _prepare_restore(self, memory: Any) -> bool:
        """Prepare `_setup` for a memory that `_recall` will get.

        Returns:
            Whether the world must be set up again for it; otherwise it may already fit.
        """
        return False

    def _constants(self) -> dict[str, Any]:
        """Return this layer's description for the episode's log, as plain data."""
        return {}

    def _snapshot_own(self) -> dict[str, Any]:
        base = self.unwrapped
        return {
            "action": copy_tree(self.action),
            "observation": copy_tree(self.observation),
            "attributes": own_state.take(self, base.derived.layers, base.simulator),
            "memory": copy_tree(self._memory()),
        }

    def _restore_own(self, own: dict[str, Any]) -> None:
        self.action = fill(self.action, own["action"])
        self.observation = fill(self.observation, own["observation"])
        base = self.unwrapped
        own_state.put_back(self, base.derived.layers, base.simulator, own["attributes"])
        self._recall(copy_tree(own["memory"]))


def _defines(kind: type, name: str) -> bool:
    """Return whether a class derived from `PipelineEnv` defines an attribute that can be set."""
    for each in kind.__mro__:
        if each in (PipelineEnv, SharedArrays, gymnasium.Env, object):
            return False
        if name in vars(each):
            value = vars(each)[name]
            return not isinstance(value, property) or value.fset is not None
    return False
