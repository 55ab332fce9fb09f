"""The base environment: a robot in a world, to be controlled step by step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from physx_core.components import Factory
from physx_core.errors import ConfigError, EpisodeError, UsageError
from physx_core.typing import Vector
from physx_gym.env.episodes import Episodes
from physx_gym.env.pipeline_env import Info
from physx_gym.simulator.boxes import action_space_of, observation_space_of, observed
from physx_gym.spaces import neutral


class RobotEnv(Episodes):
    """A robot that is controlled step by step, as a Gymnasium environment.

    The observation is the time, the state of the robot, and what its sensors measure; the action is
    the motors' torques; the reward is 0. Subclasses override what differs: one with another action
    space overrides `compute_command` too, one with another observation space
    `refresh_observation`. `_initialize_action_space` and `_initialize_observation_space` are called
    at construction, and at a reset after `_setup` has changed the simulator's options.

    Members and the order in which they are called are those of the class that `Episodes` describes.
    """

    metadata = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012 - as gymnasium has it

    holds_command: ClassVar[bool | None] = None
    """Whether `compute_command` depends on nothing but the action, so that once a step is enough,
    where nothing observes between; None: if it is not overridden."""

    def _initialize_action_space(self) -> None:
        """Set `action_space`: by default a torque for each motor, within what it can give."""
        self.action_space = action_space_of(self.simulator)

    def _initialize_observation_space(self) -> None:
        """Set `observation_space`: by default that of `measurements`."""
        self.observation_space = observation_space_of(self.simulator, self.periods.longest)

    def _make_buffers(self) -> None:
        """Make `action` and `observation`, and check that subclasses belong to their spaces."""
        default = observation_space_of(self.simulator, self.periods.longest)
        self._flat_observation = None
        if self.observation_space == default:
            self.__observed, self._flat_observation, self.observation = observed(self.simulator)
        else:
            self.observation = neutral(self.observation_space)
            if type(self).refresh_observation is RobotEnv.refresh_observation:
                raise ConfigError(
                    f"{type(self).__name__} has its own observation space: override "
                    "refresh_observation, which writes into self.observation."
                )
        self.action = neutral(self.action_space)
        own_command = type(self).compute_command is not RobotEnv.compute_command
        if not own_command and np.shape(self.action) != self.robot_state.command.shape:
            raise ConfigError(
                f"{type(self).__name__} has its own action space: override compute_command, which "
                f"writes torques of the {len(self.robot_state.command)} motors into `command`."
            )

    def _is_held(self) -> bool:
        own = type(self)
        held = own.holds_command
        if held is None:
            held = own.compute_command is RobotEnv.compute_command
        observes = own.refresh_observation is not RobotEnv.refresh_observation
        return held and (not observes or self.periods.observe == self.periods.whole)

    # What happens in an episode ----------------------------------------------------------------

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Bring `observation` to the present, in place: by default it is the measurement.

        Called every `observe_dt` and at the end of each step and reset. Only `measurement` is to be
        relied on for the state.

        Args:
            measurement: What was measured: ``t``, ``states``, ``measurements``.
        """
        if self._flat_observation is not None:
            self.simulator.values.take(self.__observed, None, self._flat_observation, "clip")

    def compute_command(self, action: Any, command: Vector) -> None:
        """Write the torques of the motors, in place: by default the action.

        Called every `control_dt`, and never before the first step.

        Args:
            action: What the agent wants: `action`, within its space.
            command: Torques of the motors, shape (motors,), in N m or N of their shafts; the motors
                cut them.
        """
        command[:] = action

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the task is over, and whether the episode is to be cut off.

        By default nothing terminates, and an observation outside of its space truncates. What lasts
        longer than `simulation_duration_max` is truncated besides. Called after `observation` was
        brought to the present.

        Args:
            info: Of this step; to be added to.

        Raises:
            EpisodeError: No episode runs.
        """
        if not self.is_simulation_running:
            raise EpisodeError("has_terminated is of a running episode: call reset first.")
        return False, not self.is_inside()

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward of this step: by default 0.

        Called once a step after `has_terminated`.

        Args:
            terminated: Whether this step ended the task.
            info: Of this step; to be added to.
        """
        return 0.0

    # How an episode begins ---------------------------------------------------------------------

    def _setup(self) -> None:
        """Configure for the episode that begins.

        Called at every reset before anything of the episode exists. Options of the simulator may be
        set and forces registered here; `step_dt` is known, `control_dt` and `observe_dt` are those
        of the episode before. `reset_options` is what `reset` was given.
        """

    def _neutral(self) -> Vector:
        """Return positions of the robot, shape (nq,), to begin at.

        By default each joint is at 0, or in the middle of its limits if 0 is not within them, and a
        floating base is where the world puts it. Called by `_sample_state`.
        """
        return self.simulator.neutral()

    def _sample_state(self) -> tuple[Vector, Vector]:
        """Return the first positions and velocities, of the robot or of the whole world.

        By default the neutral positions at rest; a floating base is moved up or down so that the
        lowest collision shape touches the ground. Called once at every reset; it draws from
        `np_random`, if at all.
        """
        positions = self.simulator.place_on_ground(self._neutral())
        return positions, np.zeros(len(self.robot_state.v))

    def _initialize_buffers(self) -> None:
        """Prepare for the episode: it runs, but nothing was observed yet.

        Called once at every reset, before `_refresh_buffers`.
        """

    def _refresh_buffers(self) -> None:
        """Bring to the present what `has_terminated` and `compute_reward` share.

        Called once at every reset and step, before the last observation of the step.
        """

    # Who watches and plays ---------------------------------------------------------------------

    def _key_to_action(
        self, key: str | None, obs: Any, reward: float | None, **kwargs: Any
    ) -> Any | None:
        """Return the action of a key, for `play_interactive`; None: hold the present action.

        Called before every step.

        Args:
            key: Which was pressed since the last step; None: none.
            obs: The last observation.
            reward: The last reward; None right after `reset`.
            kwargs: What `play_interactive` was given besides.
        """
        raise UsageError(
            f"{type(self).__name__} cannot be played: override _key_to_action, which returns the "
            "action of a key."
        )

    def _draw(self, scene: Factory) -> None:
        """Draw what is shown but is not in the world, such as a goal, before the first frame.

        Args:
            scene: What to draw with.
        """

    def _redraw(self, scene: Factory) -> None:
        """Bring what `_draw` drew to the present, before every further frame.

        Args:
            scene: What it was drawn with.
        """

    def render(self) -> Any:
        """Show the world as `render_mode` says, with the options `viewer_kwargs`.

        Without a mode, a viewer follows it where there is a display; elsewhere pictures are made.

        Returns:
            A picture, shape (height, width, 3), uint8; None where a viewer shows the world.

        Raises:
            PluginNotFoundError: The viewer is not installed; the message says how to install it.
            VisualizerError: It cannot draw; the message says what is missing.
        """
        if self._own_renderer is None:
            from physx_gym.show.rendering import Renderer

            self._own_renderer = Renderer(self)
        return self._own_renderer.frame()

    def plot(self, enable_block_states: bool = False, **kwargs: Any) -> Any:
        """Plot the running episode, or the last one; see `physx_gym.show.plotting.plot`.

        Args:
            enable_block_states: Whether states of blocks are shown too.
            kwargs: For `physx_gym.show.plotting.plot`.
        """
        from physx_gym.show.plotting import plot

        return plot(self.log_data, enable_block_states=enable_block_states, **kwargs)

    def replay(self, **kwargs: Any) -> Any:
        """Show the running episode, or the last one; see `physx_gym.show.replaying.replay`."""
        from physx_gym.show.replaying import replay

        return replay(self.log_data, **kwargs)

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
            name: Of the variable; its columns begin with it.
            value: An array of float64 or int64, or nested containers of them. They are read
                whenever a row is recorded, so keep them and update them in place.
            fieldnames: Names of all numbers, nested like the value; None: numbered.
            namespace: What the name begins with; None: nothing.
            is_eval_only: Whether it is left out in training.
        """
        self.recording.telemetry.register(
            name, value, fieldnames, namespace, is_eval_only=is_eval_only
        )

    @property
    def log_data(self) -> Any:
        """What was recorded of the running episode, up to now, or of the last one.

        A dictionary of ``"constants"`` and ``"variables"``, columns by name; empty without rows.
        """
        return self.recording.data(self)
