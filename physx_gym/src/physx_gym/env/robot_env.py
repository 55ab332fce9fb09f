"""The base environment: a robot in a world, controlled step by step."""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from physx_core import checks
from physx_core.components import Factory
from physx_core.errors import ConfigError, EpisodeError, UnknownOptionError, UsageError
from physx_core.typing import Vector
from physx_gym.env import subclass_checks
from physx_gym.env.control_loop import ControlLoop
from physx_gym.env.default_spaces import (
    action_space_of,
    allocate_observation,
    observation_space_of,
)
from physx_gym.env.observation_checks import ObservationChecks
from physx_gym.env.pipeline_env import Info, PipelineEnv, Step
from physx_gym.env.timing import StepTiming
from physx_gym.simulator.simulator import make_simulator, simulator_options
from physx_gym.spaces import copy_tree, fill, neutral
from physx_gym.telemetry.episode_recorder import EpisodeRecorder
from physx_gym.telemetry.logged_actions import LoggedActions, describe_spec
from physx_sim import BodySettings, Wrench
from physx_sim.errors import SimulationError

_PUSH_SECONDS = 0.1


class RobotEnv(PipelineEnv):
    """A robot that is controlled step by step, as a Gymnasium environment.

    By default, the observation is the time, the robot's state and its sensors' measurements, the
    action is the motors' torques, and the reward is 0. Subclasses override what differs: a new
    action space also requires `compute_command`, a new observation space `refresh_observation`.
    `_initialize_action_space` and `_initialize_observation_space` are called at construction, and
    at a reset after `_setup` has changed the simulator's options.

    Sequence of a reset: `stop`; seeding; removal of registered forces; `_setup`, then that of the
    layers; spaces, if the simulator was rebuilt; neutral actions; `_sample_state`; start of the
    simulation; `_initialize_buffers`; `_refresh_buffers`; `refresh_observation`; `has_terminated`.

    Sequence of a step: the action is checked and clipped; `compute_command` is called every
    `control_dt`, `refresh_observation` every `observe_dt` (before a command at the same time); then
    `_refresh_buffers`, `refresh_observation`, `has_terminated` and `compute_reward`, once each. All
    methods are called on the outermost environment. An exception stops the episode.
    """

    metadata = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012 - as in gymnasium

    holds_command: ClassVar[bool | None] = None
    """Whether `compute_command` depends only on the action, so that one call per step is enough if
    nothing observes in between; None: only if it is not overridden."""

    view: ClassVar[Mapping[str, Sequence[float]]] = {}
    """``eye`` and ``target`` of the camera that `render` uses, in m; by default it shows all
    objects."""

    constants: ClassVar[tuple[str, ...]] = (
        *("simulator", "robot", "robot_state", "stepper_state", "measurements", "num_steps"),
        *("is_simulation_running", "action_space", "observation_space", "action", "observation"),
        *("render_mode", "debug", "step_dt", "metadata", "simulation_duration_max", "control_dt"),
        *("observe_dt", "reset_options", "viewer_kwargs", "recorder", "_control_loop", "_spec"),
        *("_outermost", "_own_renderer", "_own_quantities", "_is_training", "_has_left_space"),
        *("_flat_observation", "_observed_index", "_np_random", "_np_random_seed"),
    )
    _spec: EnvSpec | None = None
    _left_out: ClassVar[frozenset[str]] = frozenset({"_outermost", "_own_renderer"})

    def __init__(
        self,
        simulator: Any,
        step_dt: float,
        simulation_duration_max: float = 86400.0,
        debug: bool = False,
        render_mode: str | None = None,
        *,
        engine: Any = None,
        **kwargs: Any,
    ) -> None:
        """Create an environment; nothing runs before `reset`.

        Args:
            simulator: A `Simulator`; or a world, or the path or name of a robot, to create one.
            step_dt: Duration of a step, in s; a multiple of the control and observation periods.
            simulation_duration_max: Time, in s, after which an episode is truncated.
            debug: Whether to record every physics step, even in training.
            render_mode: ``"human"``, ``"rgb_array"``, or None: whichever is possible.
            engine: Reference of the engine, instead of the simulator's: an alias of the option
                ``backend``, for trainers that have an option of that name.
            kwargs: Options of `Simulator.build` or `Simulator`, if one is created; all others go to
                the next class in the method resolution order, if there are several base classes.

        Raises:
            ConfigError: If an option is invalid.
        """
        known = simulator_options(simulator)
        simulator, kwargs = make_simulator(simulator, kwargs)
        if engine is not None:
            simulator.change_backend(engine)
        subclass_checks.construct_next(RobotEnv, self, kwargs, known)
        subclass_checks.check_mode(render_mode, self.metadata["render_modes"])
        self.simulator, self.render_mode, self.debug = simulator, render_mode, bool(debug)
        self.step_dt = checks.positive("step_dt", step_dt)
        self.metadata = subclass_checks.metadata_of(type(self), self.step_dt)
        self.simulation_duration_max = simulation_duration_max
        self.num_steps = np.full((), -1, np.int64)
        self.reset_options: dict[str, Any] = {}
        self.viewer_kwargs: dict[str, Any] = {}
        self.recorder = EpisodeRecorder(simulator)
        self.control_dt = self.observe_dt = -1.0
        self._control_loop = ControlLoop()
        self._outermost: weakref.ref[PipelineEnv] | None = None
        self._own_renderer: Any = None
        self._own_quantities: Any = None
        self._is_training = True
        self._has_left_space = False
        self._set_timing()
        self._initialize_spaces()

    # Spaces and buffers ------------------------------------------------------------------------

    def _initialize_action_space(self) -> None:
        """Set `action_space`: by default the torques that the motors can exert."""
        self.action_space = action_space_of(self.simulator)

    def _initialize_observation_space(self) -> None:
        """Set `observation_space`: by default that of `measurements`."""
        longest = self._control_loop.timing.longest
        self.observation_space = observation_space_of(self.simulator, longest)

    def _set_timing(self) -> None:
        """Determine when commands and observations are due within a step."""
        simulator = self.simulator
        self._control_loop.timing = timing = StepTiming(
            simulator.period,
            self.step_dt,
            simulator.control_period,
            simulator.observe_period,
            self.simulation_duration_max,
        )
        self.control_dt, self.observe_dt = timing.control_dt, timing.observe_dt
        simulator.set_reading_period(1 if self.debug else timing.tick)

    def _initialize_spaces(self) -> None:
        """Initialize what depends on the simulator: spaces, buffers and their checks."""
        simulator, loop = self.simulator, self._control_loop
        simulator.prepare()
        self.robot, self.robot_state = simulator.robot, simulator.robot_state
        self.stepper_state, self.measurements = simulator.stepper_state, simulator.measurements
        self.is_simulation_running = simulator.is_simulation_running
        self._initialize_action_space()
        self._initialize_observation_space()
        subclass_checks.check_spaces(self)
        self._allocate_buffers()
        loop.own_checks = ObservationChecks(self.observation_space, self._flat_observation)
        loop.builds = simulator.builds

    def _allocate_buffers(self) -> None:
        """Allocate `action` and `observation`; check that the subclass supports its own spaces."""
        default = observation_space_of(self.simulator, self._control_loop.timing.longest)
        self._flat_observation: Any = None
        if self.observation_space == default:
            self._observed_index, self._flat_observation, self.observation = allocate_observation(
                self.simulator
            )
        else:
            self.observation = neutral(self.observation_space)
            if type(self).refresh_observation is RobotEnv.refresh_observation:
                raise ConfigError(
                    f"{type(self).__name__} has its own observation space: override "
                    "refresh_observation, which writes into self.observation."
                )
        self.action = neutral(self.action_space)
        has_own_command = type(self).compute_command is not RobotEnv.compute_command
        if not has_own_command and np.shape(self.action) != self.robot_state.command.shape:
            raise ConfigError(
                f"{type(self).__name__} has its own action space: override compute_command, which "
                f"writes torques of the {len(self.robot_state.command)} motors into `command`."
            )

    # What subclasses may override --------------------------------------------------------------

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Update `observation` in place: by default, with the measurement.

        See `PipelineEnv.refresh_observation`. Take the state from `measurement` only.
        """
        if self._flat_observation is not None:
            self.simulator.values.take(self._observed_index, None, self._flat_observation, "clip")

    def compute_command(self, action: Any, command: Vector) -> None:
        """Write the torques of the motors in place: by default, the action.

        See `PipelineEnv.compute_command`. Never called before the first step; the motors clip the
        torques.
        """
        command[:] = action

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the task is over, and whether to cut off the episode.

        By default, an episode never terminates, and an observation outside its space truncates it.
        Episodes longer than `simulation_duration_max` are truncated in any case. Called after
        `observation` has been updated; see `PipelineEnv.has_terminated`.

        Raises:
            EpisodeError: If no episode is running.
        """
        if not self.is_simulation_running:
            raise EpisodeError("has_terminated needs a running episode: call reset first.")
        return False, not self.is_inside()

    def is_inside(self) -> bool:
        """Return whether `observation` is within its space; warn the first time it is not."""
        loop = self._control_loop
        inside = loop.own_checks.is_inside(self.observation)
        loop.is_finite = inside and loop.own_checks.excludes_nan
        if not inside and not self._has_left_space:
            self._has_left_space = True
            warnings.warn(
                f"An observation of {type(self).__name__} is outside its space: "
                f"{loop.own_checks.describe_outside(self.observation)}. If that is not a failure "
                "of the task, widen the space.",
                stacklevel=2,
            )
        return inside

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return the reward of this step: by default 0.

        Called once a step after `has_terminated`; see `PipelineEnv.compute_reward`.
        """
        return 0.0

    def _setup(self) -> None:
        """Configure the next episode.

        Called at every reset, before the episode starts. Options of the simulator may be set and
        forces registered here; `step_dt` is known, `control_dt` and `observe_dt` are those of the
        previous episode. `reset_options` has the options passed to `reset`.
        """

    def _neutral(self) -> Vector:
        """Return the neutral positions of the robot, shape (nq,).

        By default, each joint is at 0, or in the middle of its limits if 0 is outside them, or the
        nearest position that leaders and couplings allow, and a floating base is where the world
        puts it. Called by `_sample_state`.
        """
        return self.simulator.neutral()

    def _sample_state(self) -> tuple[Vector, Vector]:
        """Return the initial positions and velocities, of the robot or of the whole world.

        By default, the neutral positions at rest; a floating base is moved up or down so that the
        lowest collision shape touches the ground. Called once at every reset; draw random numbers
        from `np_random` only.
        """
        positions = self.simulator.place_on_ground(self._neutral())
        return positions, np.zeros(len(self.robot_state.v))

    def _initialize_buffers(self) -> None:
        """Prepare for the episode; called once at every reset, before `_refresh_buffers`."""

    def _refresh_buffers(self) -> None:
        """Update what `has_terminated` and `compute_reward` share.

        Called once at every reset and step, before the last observation of the step.
        """

    def _key_to_action(
        self, key: str | None, obs: Any, reward: float | None, **kwargs: Any
    ) -> Any | None:
        """Return the action for a key, for `play_interactive`; None: keep the present action.

        Called before every step.

        Args:
            key: The key pressed since the last step; None: none.
            obs: The last observation.
            reward: The last reward; None right after `reset`.
            kwargs: Further options of `play_interactive`.
        """
        raise UsageError(
            f"{type(self).__name__} cannot be played: override _key_to_action to return the action "
            "for a key."
        )

    def _draw(self, scene: Factory) -> None:
        """Draw what is not simulated, such as a goal, before the first frame.

        Also called at the start of a recorded episode, and `_redraw` after each of its steps, so
        that replays show the drawings.

        Args:
            scene: Factory to draw with.
        """

    def _redraw(self, scene: Factory) -> None:
        """Update what `_draw` drew, before every subsequent frame.

        Args:
            scene: Factory used by `_draw`.
        """

    # The pipeline ------------------------------------------------------------------------------

    @property
    def unwrapped(self) -> RobotEnv:
        """This environment."""
        return self

    @property
    def spec(self) -> EnvSpec | None:
        """How `gymnasium.make` created it, and after how many steps it truncates an episode."""
        if self._spec is not None:
            self._spec.max_episode_steps = self._control_loop.timing.most_steps
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec

    @property
    def derived(self) -> PipelineEnv:
        """The outermost layer on this environment; the environment itself if there is none."""
        found = None if self._outermost is None else self._outermost()
        return self if found is None else found

    @property
    def layers(self) -> tuple[PipelineEnv, ...]:
        """This environment alone."""
        return (self,)

    def _update_pipeline(self, outermost: PipelineEnv | None) -> None:
        """Make a layer the outermost of the pipeline; None: this environment alone."""
        self.adopt(outermost)
        if self._control_loop.is_ready:
            self._control_loop.refuse("The pipeline has changed: call reset().")

    def adopt(self, outermost: PipelineEnv | None) -> None:
        """Make a layer the outermost of the pipeline without ending its episode."""
        if outermost is None or outermost is self:
            self._outermost = None
        else:
            self._outermost = weakref.ref(outermost)

    @property
    def quantities(self) -> Any:
        """Values that rewards and terminations share, computed at most once a step."""
        if self._own_quantities is None:
            from physx_gym.tasks.quantities import Quantities

            self._own_quantities = Quantities(self.simulator, self.step_dt)
        return self._own_quantities

    @property
    def training(self) -> bool:
        """Whether the mode is training; see `PipelineEnv.training`."""
        return self._is_training

    def train(self, mode: bool = True) -> None:
        """Switch between training and evaluation; see `PipelineEnv.train`.

        Raises:
            EpisodeError: If an episode is running in the other mode.
        """
        if bool(mode) is not self._is_training and self.is_simulation_running:
            raise EpisodeError("An episode is running: call stop() before train() or eval().")
        self._is_training = bool(mode)

    # Reset -------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, Info]:
        """Start an episode without layers; see `PipelineEnv.reset`."""
        return self.run_reset(self, seed, options)

    def run_reset(
        self, outermost: PipelineEnv, seed: int | None, options: dict[str, Any] | None
    ) -> tuple[Any, Info]:
        """Start an episode with the given outermost environment; see `reset`.

        Raises:
            EpisodeError: If the initial state already ends the episode.
            ConfigError: If the options are not a mapping, or the periods are incompatible.
            SimulationError: If the initial state is invalid.
        """
        if options is not None and not isinstance(options, Mapping):
            raise ConfigError(f"The options of reset are {options!r} but must be a mapping.")
        self.stop()
        simulator, loop, layers = self.simulator, self._control_loop, outermost.layers
        self._update_pipeline(outermost)
        if seed is not None or self._np_random is None:
            self._initialize_seed(seed)
        self.reset_options = dict(options or {})
        simulator.remove_all_forces()
        for layer in layers:
            layer._setup()
        self._set_timing()
        simulator.prepare()
        if simulator.builds != loop.builds:
            self.recorder.telemetry.renew()
            self._initialize_spaces()
            for layer in layers[1:]:
                layer._initialize_action_space()
                layer._initialize_observation_space()
            self._seed_spaces(layers)
        loop.episode += 1
        for layer in layers:
            fill(layer.action, neutral(layer.action_space))
        self.num_steps[...] = loop.steps = 0
        state = subclass_checks.check_pair(self, "_sample_state", self._sample_state())
        if self._own_quantities is not None:
            self._own_quantities.reset()
        try:
            simulator.start(*state)
            info = self._begin_episode(outermost, loop)
        except BaseException:
            self.stop()
            raise
        loop.is_ready = True
        if self.render_mode == "human":
            self.render()
        return loop.copy(outermost.observation), info

    def _initialize_seed(self, seed: int | None = None) -> None:
        """Seed all randomness: states, errors of sensors, samples of spaces.

        Args:
            seed: A seed of at least 0; None: a random one.
        """
        if seed is None:
            self._np_random, self._np_random_seed = gymnasium.utils.seeding.np_random()
        else:
            gymnasium.Env.reset(self, seed=seed)
        self._control_loop.episode = 0
        self.simulator.seed(np.random.SeedSequence(self.np_random_seed, spawn_key=(1,)))
        self._seed_spaces(self.derived.layers)

    def _seed_spaces(self, layers: tuple[PipelineEnv, ...]) -> None:
        """Seed the samples of the layers' spaces, unless the seed of the environment is unknown."""
        episode = self._control_loop.episode
        for i, layer in enumerate(layers if self.np_random_seed >= 0 else ()):
            for k, space in enumerate((layer.action_space, layer.observation_space)):
                key = (2, i, k, episode) if episode else (2, i, k)
                sequence = np.random.SeedSequence(self.np_random_seed, spawn_key=key)
                space.seed(int(sequence.generate_state(1)[0]))

    def _begin_episode(self, outermost: PipelineEnv, loop: ControlLoop) -> Info:
        """Observe the initial state, and prepare for steps."""
        outermost._initialize_buffers()
        outermost._refresh_buffers()
        if self._own_quantities is not None:
            self._own_quantities.clear()
        if outermost.refresh_observation(self.measurements) is not None:
            raise subclass_checks.not_written(outermost, "refresh_observation", "self.observation")
        loop.connect(outermost, outermost is self)
        loop.checks.check_form(outermost.observation)
        loop.checks.check_finite(outermost.observation)
        info: Info = {}
        loop.is_recorded = self.debug or not self._is_training
        self._begin_recording(outermost, loop.is_recorded, info)
        is_held = outermost is self and not loop.is_recorded and self._is_command_held()
        loop.schedule = loop.timing.schedule(is_held, loop.is_recorded and self.debug)
        ends = subclass_checks.check_pair(
            outermost, "has_terminated", outermost.has_terminated(info)
        )
        subclass_checks.check_info(outermost, info)
        if any(ends):
            word = "terminated" if ends[0] else "truncated"
            raise EpisodeError(
                f"The episode is already {word} in its initial state. Look at _sample_state and "
                f"has_terminated; the first observation is {outermost.observation}."
            )
        return info

    def _begin_recording(self, outermost: PipelineEnv, everything: bool, info: Info) -> None:
        """Start recording: everything, with a file named in the information, or the minimum."""
        constants: dict[str, Any] = {
            "seed": self.np_random_seed,
            "step_dt": self.step_dt,
            "control_dt": self.control_dt,
            "observe_dt": self.observe_dt,
            "view": dict(self.view),
        }
        for layer in outermost.layers:
            constants |= layer._constants()
        name, path = type(self).__name__, self.reset_options.get("log_path")
        if everything:
            constants["spec"] = describe_spec(self.spec)
            info["log_path"] = self.recorder.begin(
                name, outermost.action, path, constants, self._draw
            )
        else:
            self.recorder.begin_training(name, constants)

    def _is_command_held(self) -> bool:
        """Return whether commands and observations within a step make no difference."""
        own, timing = type(self), self._control_loop.timing
        is_held = own.holds_command
        if is_held is None:
            is_held = own.compute_command is RobotEnv.compute_command
        observes = own.refresh_observation is not RobotEnv.refresh_observation
        return is_held and (not observes or timing.observe == timing.step)

    # Step --------------------------------------------------------------------------------------

    def step(self, action: Any) -> Step:
        """Simulate `step_dt` under an action; see `PipelineEnv.step`."""
        return self.run_step(self, action)

    def run_step(self, outermost: PipelineEnv, action: Any) -> Step:
        """Simulate a step under an action of the outermost environment; see `step`.

        Raises:
            EpisodeError: If no episode is running, it is over, or another layer started it.
            ActionError: If the action does not have the form of the action space, or is not finite.
            SimulationError: If the simulation, an observation or a reward is no longer finite.
        """
        loop = self._control_loop
        if not loop.is_ready or outermost is not self.derived:
            raise self._step_error(outermost)
        loop.actions.write(action)
        try:
            self._simulate(outermost, loop)
            outermost.refresh_observation(self.measurements)
            info: Info = {}
            loop.is_finite = False
            terminated, truncated = outermost.has_terminated(info)
            if not loop.is_finite or outermost is not self:
                loop.checks.check_finite(outermost.observation)
            if self.stepper_state.iter >= loop.timing.last:
                truncated = True
            reward = outermost.compute_reward(terminated, info)
            if type(reward) is not float:
                reward = subclass_checks.check_number(outermost, reward)
            subclass_checks.check_info(outermost, info)
            if reward != reward:
                raise SimulationError(f"The reward of {type(outermost).__name__} is not a number.")
            if loop.is_recorded:
                self.recorder.end_step(reward, self._redraw)
        except BaseException:
            self.stop()
            raise
        if terminated or truncated:
            loop.refuse(
                f"The episode {'terminated' if terminated else 'was truncated'}: call reset()."
            )
        if self.render_mode == "human":
            self.render()
        observation = loop.copy(outermost.observation)
        return observation, reward, bool(terminated), bool(truncated), info

    def _simulate(self, outermost: PipelineEnv, loop: ControlLoop) -> None:
        """Control and simulate for a step, up to its last observation."""
        simulator, quantities = self.simulator, self._own_quantities
        measurements, command = self.measurements, self.robot_state.command
        if not loop.is_recorded:
            self.recorder.telemetry.record(self.stepper_state.t)
        for observe, control, steps in loop.schedule:
            if observe:
                outermost.refresh_observation(measurements)
            if control:
                if outermost.compute_command(outermost.action, command) is not None:
                    raise subclass_checks.not_written(outermost, "compute_command", "command")
                simulator.apply_command()
            if loop.is_recorded:
                self.recorder.record()
            simulator.step(steps)
        loop.steps += 1
        self.num_steps[()] = loop.steps
        outermost._refresh_buffers()
        if quantities is not None:
            quantities.clear()

    def _step_error(self, outermost: PipelineEnv) -> EpisodeError:
        if not self._control_loop.is_ready:
            return EpisodeError(self._control_loop.reason)
        return EpisodeError(
            f"The episode belongs to {type(self.derived).__name__}, the outermost of the "
            f"pipeline, but step was called on {type(outermost).__name__}: call step there, or "
            "reset here."
        )

    def stop(self) -> None:
        """End the episode and write its recording. Call `reset` to start the next."""
        if self.is_simulation_running:
            self.recorder.end(keep=self._control_loop.steps > 0)
            self.simulator.stop()
            self._control_loop.refuse("The episode was stopped: call reset().")

    def close(self) -> None:
        """Stop, and free engine and viewer; the environment can still be `reset`."""
        self.stop()
        if self._own_renderer is not None:
            self._own_renderer.close()
            self._own_renderer = None
        self.recorder.close()
        self.simulator.close()

    def render(self) -> Any:
        """Show the world according to `render_mode`, with the options `viewer_kwargs`.

        Without a mode, a viewer shows it if there is a display; otherwise, pictures are rendered.

        Returns:
            A picture, shape (height, width, 3), uint8; None if a viewer shows the world.

        Raises:
            PluginNotFoundError: If the viewer is not installed.
            VisualizerError: If the viewer cannot draw; the message says what is missing.
        """
        if self._own_renderer is None:
            from physx_gym.visualization.rendering import Renderer

            self._own_renderer = Renderer(self)
        return self._own_renderer.frame()

    def make_drawing(self, factory: Factory) -> Callable[[], None]:
        """Return a function that draws the present state with a factory; for pipelines."""
        from physx_gym.visualization.environment_drawing import EnvironmentDrawing

        return EnvironmentDrawing(self, factory).draw

    def logged_actions(self, path: str | Path) -> LoggedActions:
        """Return the actions of an episode that this environment, made as now, has recorded.

        Args:
            path: Its log.

        Raises:
            LogError: If it is no log, or lacks the seed, actions or states.
        """
        return LoggedActions(path, self.simulator, self.derived.action_space)

    def perturb(self, **values: Any) -> None:
        """Change something in a running episode: see `physx_core.Environment.perturb`.

        Args:
            values: ``push``: forces by body, which act for 0.1 s, in N, shape (3,), world frame;
                ``gravity``: in m/s^2, shape (3,); ``bodies``: options of `physx_sim.BodySettings`
                by body, such as ``{"box": {"mass": 2.0}}``.

        Raises:
            UnknownOptionError: If there is no such value, or option of a body.
            SimulationError: If there is no such body, or the engine cannot change it.
            ConfigError: If a value is out of range.
        """
        known = ("push", "gravity", "bodies")
        if unknown := values.keys() - set(known):
            raise UnknownOptionError("perturb()", unknown, known)
        simulation = self.simulator.simulation
        for name, force in values.get("push", {}).items():
            simulation.apply_wrench(Wrench(name, force, duration=_PUSH_SECONDS))
        if "gravity" in values:
            simulation.set_gravity(values["gravity"])
        for name, settings in values.get("bodies", {}).items():
            simulation.set_body(name, BodySettings(**settings))

    def pull(self, name: str, node: int, force: Vector) -> None:
        """Pull at a robot's body or an object for a step: see `physx_core.Environment.pull`.

        Args:
            name: Name of the robot or object.
            node: Index of the robot's body in the engine's layout; of an object 0.
            force: In N, world frame, shape (3,).
        """
        simulator, layout = self.simulator, self.simulator.layout
        part = layout.parts.get(name)
        body = name if part is None else layout.names[part.bodies][node]
        if force.any():
            simulator.simulation.apply_wrench(Wrench(body, force, duration=self.step_dt))

    # State -------------------------------------------------------------------------------------

    def restore(self, state: Any) -> None:
        """Restore a snapshot without layers; see `PipelineEnv.restore`."""
        self.run_restore(self, state)

    def run_restore(self, outermost: PipelineEnv, state: Any) -> None:
        """Restore a snapshot of a pipeline; see `restore`.

        Raises:
            SimulationError: If the snapshot is of a different environment.
        """
        layers = outermost.layers
        names = [type(layer).__name__ for layer in layers]
        if not isinstance(state, dict) or state.get("layers") != names or "own" not in state:
            given = state.get("layers") if isinstance(state, dict) else state
            raise SimulationError(f"The snapshot is of {given}, not of {names}.")
        runs = state["own"][0]["simulator"]["running"]
        memories = [own["memory"] for own in state["own"]]
        prepared = [
            layer._prepare_restore(each) for layer, each in zip(layers, memories, strict=True)
        ]
        if any(prepared):
            self.stop()
        if not runs or self.derived is not outermost or not self.is_simulation_running:
            self.run_reset(outermost, None, state["own"][0]["options"])
        for layer, own in zip(layers, state["own"], strict=True):
            layer._restore_own(own)
        if not runs:
            self.recorder.telemetry.discard()

    def _snapshot_own(self) -> dict[str, Any]:
        loop, quantities = self._control_loop, self._own_quantities
        return super()._snapshot_own() | {
            "simulator": self.simulator.snapshot(),
            "random": copy_tree(self.np_random.bit_generator.state),
            "seed": self.np_random_seed,
            "episode": loop.episode,
            "num_steps": int(self.num_steps),
            "ready": (loop.is_ready, loop.reason),
            "options": dict(self.reset_options),
            "quantities": None if quantities is None else quantities.snapshot(),
        }

    def _restore_own(self, own: dict[str, Any]) -> None:
        loop = self._control_loop
        self.simulator.restore(own["simulator"])
        self.np_random.bit_generator.state = own["random"]
        self._np_random_seed, loop.episode = own["seed"], own["episode"]
        self.num_steps[...] = loop.steps = own["num_steps"]
        loop.is_ready, loop.reason = own["ready"]
        self.reset_options = dict(own["options"])
        self.recorder.rewind(self.stepper_state.t)
        if own["quantities"] is not None or self._own_quantities is not None:
            self.quantities.restore(own["quantities"] or [])
        super()._restore_own(own)
