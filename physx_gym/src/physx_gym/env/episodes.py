"""The order in which everything happens in an episode of a pipeline."""

from __future__ import annotations

import weakref
from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np

from physx_core import checks
from physx_core.errors import ConfigError, EpisodeError, SimulationError
from physx_gym.env import seeding
from physx_gym.env import subclass_checks as inheritance
from physx_gym.env.actions import Actions
from physx_gym.env.observation_checks import ObservationChecks
from physx_gym.env.pipeline_env import Info, PipelineEnv, Step
from physx_gym.simulator.periods import Periods
from physx_gym.simulator.simulator import Simulator, make_simulator
from physx_gym.spaces import copier, copy_tree, fill, neutral
from physx_gym.telemetry.recording import Recording

if TYPE_CHECKING:
    from physx_gym.env.robot_env import RobotEnv


class Episodes(PipelineEnv):
    """What `RobotEnv` does at construction, reset, step and stop, for the pipeline on it.

    Construction: `_initialize_action_space`, `_initialize_observation_space`.

    Reset: `stop`; the seed; registered forces are removed; `_setup`; spaces, if the simulator was
    rebuilt; actions become neutral; `_setup` of the layers; `_sample_state`; the simulation starts;
    `_initialize_buffers`; `_refresh_buffers`; `refresh_observation`; `has_terminated`.

    Step: the action is checked and cut; every `control_dt` `compute_command`, every `observe_dt`
    `refresh_observation` (before a command of the same moment); then once `_refresh_buffers`,
    `refresh_observation`, `has_terminated`, `compute_reward`. Methods are those of the top of the
    pipeline. An exception stops the episode.

    What it remembers has names with two underscores, so that subclasses may call theirs as they
    like.
    """

    _left_out: ClassVar[frozenset[str]] = frozenset({"_Episodes__derived", "_own_renderer"})

    def __init__(
        self,
        simulator: Any,
        step_dt: float,
        simulation_duration_max: float = 86400.0,
        debug: bool = False,
        render_mode: str | None = None,
        **kwargs: Any,
    ) -> None:
        """Make an environment; nothing runs before `reset`.

        Args:
            simulator: A `Simulator`; or a world, or the path or name of a robot, of which one is
                made.
            step_dt: Time of a step, in s; a multiple of the control and observation periods.
            simulation_duration_max: Time, in s, after which an episode is truncated.
            debug: Whether every physics step is recorded, in training too.
            render_mode: ``"human"``, ``"rgb_array"``, or None: what `render` finds possible.
            kwargs: Options of `Simulator.build` or `Simulator`, where one is made; otherwise those
                of the next of several classes that an environment inherits from.

        Raises:
            ConfigError: An option cannot be.
        """
        if not isinstance(simulator, Simulator):
            simulator, kwargs = make_simulator(simulator, kwargs), {}
        inheritance.construct_next(Episodes, self, kwargs)
        inheritance.check_mode(render_mode, self.metadata["render_modes"])
        self.simulator, self.render_mode, self.debug = simulator, render_mode, bool(debug)
        self.step_dt = checks.positive("step_dt", step_dt)
        self.metadata = inheritance.metadata_of(type(self), self.step_dt)
        self.simulation_duration_max = simulation_duration_max
        self.num_steps = np.full((), -1, np.int64)
        self.reset_options: dict[str, Any] = {}
        self.viewer_kwargs: dict[str, Any] = {}
        self.recording = Recording()
        self.control_dt = self.observe_dt = -1.0
        self.__derived: weakref.ref[PipelineEnv] | None = None
        self._own_renderer: Any = None
        self.__quantities: Any = None
        self.__training, self.__ready, self.__why = True, False, "Call reset() before step()."
        self.__builds, self.__count, self.__episode, self.__is_sound = -1, -1, 0, False
        self._flat_observation: Any = None
        self.__set_periods()
        self.__initialize_spaces()

    # Overridden by RobotEnv --------------------------------------------------------------------

    @abstractmethod
    def _make_buffers(self) -> None:
        """Make `action` and `observation`."""

    @abstractmethod
    def _sample_state(self) -> tuple[Any, Any]:
        """Return the first state."""

    # The pipeline ----------------------------------------------------------------------------

    @property
    def unwrapped(self) -> RobotEnv:
        """This environment."""
        return self  # type: ignore[return-value]

    @property
    def derived(self) -> PipelineEnv:
        """The topmost layer of the pipeline on this environment; itself, if there is none."""
        found = None if self.__derived is None else self.__derived()
        return self if found is None else found

    def _update_pipeline(self, derived: PipelineEnv | None) -> None:
        """Make a layer the top of the pipeline; None: this environment alone."""
        top = self if derived is None else derived
        self.__derived = None if top is self else weakref.ref(top)
        if self.__ready:
            self.__ready, self.__why = False, "The pipeline has changed: call reset()."

    @property
    def quantities(self) -> Any:
        """Values that rewards and terminations share, computed at most once a step."""
        if self.__quantities is None:
            from physx_gym.tasks.quantities import Quantities

            self.__quantities = Quantities(self)
        return self.__quantities

    # Settings --------------------------------------------------------------------------------

    @property
    def training(self) -> bool:
        """Whether this is for training; otherwise for evaluation, where episodes are recorded."""
        return self.__training

    def train(self, mode: bool = True) -> None:
        """Switch between training and evaluation.

        Raises:
            EpisodeError: An episode runs.
        """
        if bool(mode) is not self.__training and self.is_simulation_running:
            raise EpisodeError("An episode runs: call stop() before train() or eval().")
        self.__training = bool(mode)

    def eval(self) -> None:
        """Switch to evaluation; see `train`."""
        self.train(False)

    def __set_periods(self) -> None:
        """Work out what is due when in a step."""
        simulator = self.simulator
        self.periods = Periods(self.step_dt, self.simulation_duration_max, simulator)
        self.control_dt, self.observe_dt = self.periods.control_dt, self.periods.observe_dt
        simulator.set_moment(1 if self.debug else self.periods.moment)

    @abstractmethod
    def _is_held(self) -> bool:
        """Return whether commands and observations within a step change nothing."""

    def __initialize_spaces(self) -> None:
        self.simulator.prepare()
        simulator = self.simulator
        self.robot, self.robot_state = simulator.robot, simulator.robot_state
        self.stepper_state, self.measurements = simulator.stepper_state, simulator.measurements
        self.is_simulation_running = simulator.is_simulation_running
        self._initialize_action_space()
        self._initialize_observation_space()
        inheritance.check_spaces(self)
        self._make_buffers()
        self.__own_checks = ObservationChecks(self.observation_space, self._flat_observation)
        self.__builds = simulator.builds

    def _initialize_seed(self, seed: int | None = None) -> None:
        """Draw everything anew from a seed: states, errors of sensors, samples of spaces.

        Args:
            seed: From 0; None: one is drawn.
        """
        if seed is None:
            self._np_random, self._np_random_seed = gymnasium.utils.seeding.np_random()
        else:
            gymnasium.Env.reset(self, seed=seed)
        self.__episode = 0
        self.simulator.seed(seeding.sensors_of(self.np_random_seed))
        seeding.seed_spaces(self.derived.layers, self.np_random_seed, 0)

    # An episode ------------------------------------------------------------------------------

    def run_reset(
        self, top: PipelineEnv, seed: int | None, options: dict[str, Any] | None
    ) -> tuple[Any, Info]:
        """Begin an episode with a layer as the top; see `reset`."""
        if options is not None and not isinstance(options, Mapping):
            raise ConfigError(f"The options of reset are {options!r} but must be a mapping.")
        self.stop()
        simulator = self.simulator
        self._update_pipeline(top)
        if seed is not None or self._np_random is None:
            self._initialize_seed(seed)
        self.reset_options = dict(options or {})
        simulator.remove_all_forces()
        self._setup()
        self.__set_periods()
        simulator.prepare()
        layers = top.layers
        if simulator.builds != self.__builds:
            self.__initialize_spaces()
            for layer in layers[1:]:
                layer._initialize_action_space()
                layer._initialize_observation_space()
            seeding.seed_spaces(layers, self.np_random_seed, self.__episode)
        self.__episode += 1
        for layer in layers:
            fill(layer.action, neutral(layer.action_space))
        self.num_steps[...] = self.__count = 0
        for layer in layers[1:]:
            layer._setup()
        positions, velocities = inheritance.pair_of(self, "_sample_state", self._sample_state())
        if self.__quantities is not None:
            self.__quantities.reset()
        try:
            simulator.start(positions, velocities)
            info = self.__begin(top)
        except BaseException:
            self.stop()
            raise
        self.__ready = True
        if self.render_mode == "human":
            self.render()
        return self.__copied(top.observation), info

    def __begin(self, top: PipelineEnv) -> Info:
        """Bring everything to the first state."""
        top._initialize_buffers()
        top._refresh_buffers()
        if self.__quantities is not None:
            self.__quantities.clear()
        if top.refresh_observation(self.measurements) is not None:
            raise inheritance.not_written(top, "refresh_observation", "self.observation")
        self.__attend(top)
        self.__checks.check_form(top.observation)
        self.__checks.check_finite(top.observation)
        info: Info = {}
        self.__records = self.recording.begin(self, top, info)
        held = top is self and not self.__records and self._is_held()
        self.__last_step = self.periods.last
        self.__schedule = self.periods.schedule(held, self.__records and self.debug)
        terminated, truncated = inheritance.pair_of(top, "has_terminated", top.has_terminated(info))
        if terminated or truncated:
            word = "terminated" if terminated else "truncated"
            raise EpisodeError(
                f"The episode is {word} at its first state already. Look at _sample_state and "
                f"has_terminated; what was observed is {top.observation}."
            )
        return info

    def __attend(self, top: PipelineEnv) -> None:
        """Take actions from, and check observations of, the top of the pipeline."""
        self.__actions = Actions(top.action_space, top.action)
        alone = top is self
        self.__checks = self.__own_checks if alone else ObservationChecks(top.observation_space)
        self.__copied = copier(top.observation_space)

    def run_step(self, top: PipelineEnv, action: Any) -> Step:
        """Simulate a step under an action of the top; see `step`."""
        if not self.__ready or top is not self.derived:
            raise self.__refusal(top)
        self.__actions.take(action)
        try:
            self.__run(top)
            top.refresh_observation(self.measurements)
            info: Info = {}
            self.__is_sound = False
            terminated, truncated = top.has_terminated(info)
            if not self.__is_sound or top is not self:
                self.__checks.check_finite(top.observation)
            if self.stepper_state.iter >= self.__last_step:
                truncated = True
            reward = top.compute_reward(terminated, info)
            if type(reward) is not float:
                reward = inheritance.number_of(top, reward)
            if reward != reward:
                raise SimulationError(f"The reward of {type(top).__name__} is not a number.")
        except BaseException:
            self.stop()
            raise
        if terminated or truncated:
            word = "terminated" if terminated else "was truncated"
            self.__ready, self.__why = False, f"The episode {word}: call reset()."
        if self.render_mode == "human":
            self.render()
        return self.__copied(top.observation), reward, bool(terminated), bool(truncated), info

    def __run(self, top: PipelineEnv) -> None:
        """Control and simulate for a step, up to its last observation."""
        simulator, quantities = self.simulator, self.__quantities
        measurements, command = self.measurements, self.robot_state.command
        for observe, control, steps in self.__schedule:
            if observe:
                top.refresh_observation(measurements)
            if control:
                if top.compute_command(top.action, command) is not None:
                    raise inheritance.not_written(top, "compute_command", "command")
                simulator.apply_command()
            if self.__records:
                self.recording.row(self)
            simulator.step(steps)
        self.__count += 1
        self.num_steps[()] = self.__count
        top._refresh_buffers()
        if quantities is not None:
            quantities.clear()

    def resume(self, top: PipelineEnv) -> None:
        """Make a layer the top of the pipeline without ending its episode."""
        self.__derived = None if top is self else weakref.ref(top)

    def __refusal(self, top: PipelineEnv) -> EpisodeError:
        if not self.__ready:
            return EpisodeError(self.__why)
        return EpisodeError(
            f"The episode belongs to {type(self.derived).__name__}, the top of the pipeline, but "
            f"step is of {type(top).__name__}: call step there, or reset here."
        )

    def is_inside(self) -> bool:
        """Return whether `observation` is within its space."""
        inside = self.__own_checks.inside(self.observation)
        self.__is_sound = inside and self.__own_checks.tells_nan
        return inside

    def stop(self) -> None:
        """End the episode; what was recorded is written. To go on, call `reset`."""
        if self.is_simulation_running:
            self.recording.end(self)
            self.simulator.stop()
            self.__ready, self.__why = False, "The episode was stopped: call reset()."

    def close(self) -> None:
        """Stop, and free engine and viewer; `reset` brings them back."""
        self.stop()
        if self._own_renderer is not None:
            self._own_renderer.close()
            self._own_renderer = None
        self.recording.close()
        self.simulator.close()

    # State -----------------------------------------------------------------------------------

    def run_restore(self, top: PipelineEnv, state: Any) -> None:
        """Go back to a snapshot of a layer and all below; see `restore`."""
        layers = top.layers
        names = [type(layer).__name__ for layer in layers]
        if not isinstance(state, dict) or state.get("layers") != names or "own" not in state:
            given = state.get("layers") if isinstance(state, dict) else state
            raise SimulationError(f"The snapshot is of {given}, not of {names}.")
        runs = state["own"][0]["simulator"]["running"]
        if not runs or self.derived is not top or not self.is_simulation_running:
            self.run_reset(top, None, state["own"][0]["options"])
        for layer, own in zip(layers, state["own"], strict=True):
            layer._restore_own(own)
        if not runs:
            self.recording.discard()

    def _snapshot_own(self) -> dict[str, Any]:
        quantities = self.__quantities
        return super()._snapshot_own() | {
            "simulator": self.simulator.snapshot(),
            "random": copy_tree(self.np_random.bit_generator.state),
            "seed": self.np_random_seed,
            "num_steps": int(self.num_steps),
            "ready": (self.__ready, self.__why),
            "options": dict(self.reset_options),
            "quantities": None if quantities is None else quantities.snapshot(),
        }

    def _restore_own(self, own: dict[str, Any]) -> None:
        self.simulator.restore(own["simulator"])
        self.np_random.bit_generator.state = own["random"]
        self._np_random_seed = own["seed"]
        self.num_steps[...] = self.__count = own["num_steps"]
        self.__ready, self.__why = own["ready"]
        self.reset_options = dict(own["options"])
        self.recording.rewind(self.stepper_state.t)
        if own["quantities"] is not None or self.__quantities is not None:
            self.quantities.restore(own["quantities"] or [])
        super()._restore_own(own)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take up a pickled or copied environment."""
        super().__setstate__(state)
        self.__derived = self._own_renderer = None
