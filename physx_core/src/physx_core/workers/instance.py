"""Instance: creates one environment and steps it, in this process or in a client."""

from __future__ import annotations

import copy
import inspect
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from physx_core.closeable import Closeable
from physx_core.components.environment import (
    Environment,
    PredictedFields,
    explain_missing_attribute,
)
from physx_core.components.hand import HAND, Hand
from physx_core.components.parameter import Parameter
from physx_core.components.scene.factory import Factory
from physx_core.components.services import Choose, Services
from physx_core.components.visualizer import takes_hand
from physx_core.config import EnvironmentConfig
from physx_core.errors import (
    EnvironmentFailedError,
    PhysxError,
    StateError,
    UsageError,
    WrongSamplesError,
    own_line,
)
from physx_core.fields import Field, check_together
from physx_core.plugins import resolve
from physx_core.processes.endings import describe_ending, is_ending
from physx_core.rows import RejectedSamples
from physx_core.typing import Array, Sample
from physx_core.workers.creation import create_environment

if TYPE_CHECKING:
    from physx_core.states import Baseline

PARAMETER = "parameters/"
"""Name prefix of a stored row's entries that hold the parameters it was generated with; no field
name has this prefix."""
SET = PARAMETER + "/"
"""Name of the entry with the index of the set in the dataset's record; -1: unknown."""
NO_VALUES: Mapping[str, Any] = {}
"""For an episode without parameters; never changed. A dict is unpacked faster than a view."""
_MOST_EMPTY = 1000
"""Number of episodes in a row that may end without a row."""
MOST_REJECTED = 1000
"""How many of the rejected samples of an independent episode are kept: the first ones."""
_COUNTERS = (
    *("last_step", "last_episode", "has_ended"),
    *("_next_episode", "_rows", "_counts", "_is_numbered"),
)
"""What changes about an instance."""
_STEPPING = ("reset_parameters", "perturb", "step", "check_sample", "apply_prediction", "close")


def instance_arguments(
    config: EnvironmentConfig, instance_id: int, seed: Sequence[int], accept_all: bool
) -> dict[str, Any]:
    """Return the arguments of `Instance` for one instance of a configuration."""
    return {
        "environment": config.environment,
        "env_kwargs": config.env_kwargs,
        "instance_id": instance_id,
        "instance_nb": config.num_clients,
        "seed": list(seed),
        "independent_episodes": config.independent_episodes,
        "episode_steps": config.episode_steps,
        "simulations_per_step": config.simulations_per_step,
        "max_wrong_samples": config.max_wrong_samples_per_step,
        "record_wrong": config.record_wrong_samples,
        "accept_all": accept_all,
        "hand": config.visualizer is not None
        and takes_hand(resolve("visualizer", config.visualizer)),
    }


class Instance(Closeable):
    """Calls an environment's methods in order, and names the instance in every error.

    Attributes:
        instance_id: Number of the instance, counted from 1.
        environment: The environment; None before `open` and after `close`.
        last_step: Number of the step that generated the last sample, counted from 0 over all
            episodes.
        last_episode: Number of the trajectory that the last sample belongs to, counted from 0.
        has_ended: Whether the last sample is the last one of the episode that `begin` has begun.
        rejected: The samples that `check_sample` rejected, if they are recorded; else None.
    """

    def __init__(
        self,
        environment: str | Callable[..., Any],
        env_kwargs: dict[str, Any],
        *,
        instance_id: int,
        instance_nb: int,
        seed: Sequence[int],
        independent_episodes: bool | None = None,
        episode_steps: int | None = None,
        simulations_per_step: int = 1,
        max_wrong_samples: int = 10,
        record_wrong: bool = False,
        accept_all: bool = False,
        hand: bool = False,
    ) -> None:
        """Store the arguments of the environment.

        Args:
            environment: Reference of the environment.
            env_kwargs: Its keyword arguments.
            instance_id: Number of the instance, counted from 1.
            instance_nb: How many instances run together.
            seed: Seed of the whole run.
            independent_episodes: Whether its episodes are independent; None: as it says.
            episode_steps: Number of rows of an episode; None: the environment decides.
            simulations_per_step: Calls of `step` for one sample.
            max_wrong_samples: How many consecutive samples `check_sample` may reject.
            record_wrong: Whether to keep the samples that it rejects in `rejected`.
            accept_all: Whether to ignore the verdict of `check_sample`, as in a replay.
            hand: Whether to ask the run before each row what a person does, if the environment
                defines controls.
        """
        self.instance_id = instance_id
        self.environment: Environment | None = None
        self.last_step = -1
        self.last_episode = 0
        self.has_ended = False
        self.rejected = RejectedSamples() if record_wrong else None
        self._reference = environment
        self._arguments: dict[str, Any] = {
            **env_kwargs,
            "instance_id": instance_id,
            "instance_nb": instance_nb,
            "seed": list(seed),
        }
        self._independent, self._episode_steps = independent_episodes, episode_steps
        self._sub_steps = simulations_per_step - 1
        self._max_wrong_samples = max_wrong_samples
        self._accepts_all = accept_all
        self._next_episode: int | None = None
        self._rows = 0  # of this episode
        self._counts = False  # whether rows are counted, or must be read
        self._is_numbered = False  # whether `begin` begins each episode
        self._simulate: Callable[[], Any] = self._alive
        self._draws = False
        self._drawing: Baseline | None = None
        self._refusal: StateError | None = None
        self._runner: Any = None
        self._wants_hand = hand
        self._hand: Hand | None = None

    @property
    def fields(self) -> list[Field]:
        """The environment's fields; shapes that it leaves open are None. Empty if it is closed."""
        return self.environment.fields if self.environment is not None else []

    @property
    def episode_fields(self) -> list[Field]:
        """The fields that each episode has once. Empty if the environment is closed."""
        return [] if self.environment is None else self.environment.episode_fields

    @property
    def ignores_predictions(self) -> bool:
        """Whether the environment does not define `Environment.apply_prediction`."""
        return type(self._alive()).apply_prediction is Environment.apply_prediction

    @property
    def is_independent(self) -> bool:
        """Whether the environment's episodes are independent."""
        return self._alive().independent_episodes and self._independent is not False

    @property
    def episode(self) -> int:
        """Number of the last episode that has begun."""
        return self._alive().episode_index

    @property
    def parameters(self) -> list[Parameter]:
        """The parameters that the environment defines. Empty if it is closed."""
        environment = self.environment
        return [] if environment is None else list(environment._defined_parameters)

    def open(
        self,
        services: Services | None,
        draw: bool,
        choose: Choose | None = None,
        *,
        with_states: bool = False,
    ) -> None:
        """Create the environment: `create`, `init`, `init_database`, `init_visualization`.

        Args:
            services: What the environment may request from the run; None: nothing.
            draw: Whether there is a visualizer.
            choose: Chooses the parameters of an episode; None: they are drawn from their
                distributions.
            with_states: Whether to prepare `get_state` and `set_state`, which say so if something
                cannot be captured.

        Raises:
            EnvironmentFailedError: If the environment cannot be imported or one of its methods
                raises.
            UsageError: If the environment's constructor does not pass on its arguments.
            PhysxError: If the environment raises one; it is raised unchanged.
        """
        environment = self.environment = create_environment(
            self._reference, self._arguments, self._call
        )
        environment._services, environment._choose_parameters = services, choose
        self._configure_episodes(environment)
        self._call("create", environment.create)
        self._call("init", environment.init)
        self._call("init_database", environment.init_database)
        self._simulate = self._simulate_sub_steps if self._sub_steps else environment.step
        if self._wants_hand and (environment._controls or environment._pulls):
            self._take_hand(environment, services)
        if not any(field.role == "training" for field in environment.fields):
            raise UsageError(
                f"{type(environment).__name__}.init_database() defined no training fields: "
                "call define_training_fields()."
            )
        for fields in (environment.fields, environment.episode_fields):
            check_together({field.name: field for field in fields})
        if with_states:
            self._try(self.track_states)
        self._draws = draw
        if draw:
            environment.factory, before = Factory(), set(vars(environment))
            self._call("init_visualization", environment.init_visualization)
            if self._hand is not None:
                environment.factory.add_controls(HAND, **self._hand.describe())
            environment.update_visualization()
            if with_states:
                self._try(self._track_drawing)
                environment.leave_out_of_state(vars(environment).keys() - before)

    def _take_hand(self, environment: Environment, services: Services | None) -> None:
        """Have the environment told before each row what a person does."""
        assert services is not None
        hand = self._hand = Hand(
            environment,
            environment._controls,
            environment._control_values,
            environment._pulls,
            partial(services.touch, self.instance_id),
        )
        self._call("init_database", environment.define_additional_fields, hand.field)
        simulate = self._simulate

        def simulate_by_hand() -> None:
            done = self._call("perturb", hand.act)
            result = simulate()
            if result is not None:
                self._finish(result)
            if environment._training is not None:
                environment._additional = {**(environment._additional or {}), HAND: done}

        self._simulate = simulate_by_hand

    def _track_drawing(self) -> None:
        from physx_core.states import Baseline  # most runs take no states

        self._drawing = Baseline(self._alive().factory)

    def _try(self, track: Callable[[], None]) -> None:
        """Prepare states, or note why there can be none."""
        try:
            track()
        except StateError as error:
            self._refusal = error

    def _configure_episodes(self, environment: Environment) -> None:
        """Make the episodes independent if the run's configuration says so."""
        configured = self._independent or (
            self._episode_steps is not None and self._independent is None
        )
        self._episode_steps = self._episode_steps or type(environment).episode_steps
        if not configured or environment.independent_episodes:
            return
        name = type(environment).__name__
        if type(environment).reset_parameters is Environment.reset_parameters:
            raise UsageError(
                f"The configuration says that episodes of {name} are independent, but it does not "
                "implement reset_parameters(), which prepares an episode. If nothing has to be "
                "prepared, set independent_episodes = True in the class."
            )
        if "rng" in vars(environment):
            raise UsageError(
                f"{name}.__init__() uses self.rng before it can know that its episodes are "
                "independent: set independent_episodes = True in the class."
            )
        environment.independent_episodes = True

    def begin(self, number: int, values: Mapping[str, Any] = NO_VALUES) -> None:
        """Begin an episode of a campaign, whatever this instance has simulated before.

        Args:
            number: Its number, from which its random stream follows.
            values: The values of its parameters.

        Raises:
            PhysxError: If the environment fails.
        """
        environment = self.environment or self._alive()
        if not self._is_numbered:
            self._is_numbered, self._counts = True, self._episode_steps is not None
        self._rows = 0
        if self._hand is not None:
            self._call("perturb", self._hand.let_go)
        try:
            environment.begin_number(number, values)
        except (Exception, SystemExit) as error:
            raise self._failure("reset_parameters", error) from error

    @property
    def makes_single_rows(self) -> bool:
        """Whether each step is an episode, and nothing is asked of it but its sample."""
        kept = type(self._alive()).check_sample is Environment.check_sample
        more = self._sub_steps or self._draws or self._hand is not None or self.episode_fields
        return self._episode_steps == 1 and kept and not more

    def single_rows(
        self, episodes: Iterator[tuple[int, Mapping[str, Any]]]
    ) -> Iterator[dict[str, Any]]:
        """Simulate episodes of one row: what `begin` and `step` do for each, in half the time.

        Args:
            episodes: Number and values of parameters of each.

        Yields:
            The sample of each, without further checks; empty if it has none.
        """
        environment, simulate, method = self._alive(), self._simulate, ""
        streams, reset = environment._episode_streams, environment.reset_parameters
        resets = type(environment).reset_parameters is not Environment.reset_parameters
        environment._earlier_steps, environment.step_index = environment._step_count, 0
        try:
            for number, values in episodes:
                environment.episode_index, environment._episode_is_over = number, False
                method = "reset_parameters"
                if environment.rng is not streams.generator:
                    environment._check_generator()
                streams.seek(number)
                if resets:
                    reset(**values)
                method = "step"
                if (result := simulate()) is not None:
                    self._finish(result)
                sample = environment._training
                if sample is None or environment._additional is not None:
                    sample = environment.take_sample() or {}
                environment._training = None
                yield sample
        except (Exception, SystemExit) as error:
            raise self._failure(method, error) from error

    def step(self, stored: Sample | None = None) -> dict[str, Any]:
        """Simulate until `check_sample` accepts a sample; return it without further checks.

        After the end of an episode that `begin` has begun, return an empty dictionary.

        Args:
            stored: A stored row for the environment to replay, or None. If the parameters that it
                was generated with are known, it has entries `PARAMETER` and `SET`, and an
                environment that defines parameters gets them. The row stays the same for all
                sub-steps, and after a rejected sample.

        Raises:
            UsageError: If the environment never reads the stored row.
            WrongSamplesError: If `check_sample` rejects too many consecutive samples.
            UnknownFieldError: If the step sets no data.
            EnvironmentFailedError: If the environment raises.
        """
        environment = self.environment or self._alive()
        is_new = stored is not environment._sample or environment._episode_is_over
        if is_new and not self._prepare(environment, stored):
            return {}
        wrong = empty = 0
        while True:
            method = "step"
            try:
                result = self._simulate()
                if result is not None:
                    self._finish(result)
                sample = environment.take_sample()
                method = "check_sample"
                accepted = sample is None or environment.check_sample()
                if self._draws:
                    self._show(environment)
            except (Exception, SystemExit) as error:
                raise self._failure(method, error) from error
            if sample is None:
                empty += 1
                self._note_empty(environment, empty)
            else:
                self.last_step = environment._earlier_steps + environment.step_index
                self.last_episode = environment.sample_episode
                environment.step_index += 1
                if accepted is True or self._accepts(accepted):
                    if self._counts:
                        self._count(environment)
                    self.has_ended = environment._episode_is_over
                    return sample
                wrong += 1
                self._reject(sample, wrong)
            if environment._episode_is_over and not self._prepare(environment, stored):
                return {}

    def take_episode_data(self) -> dict[str, Array]:
        """Return the fields of the episode that has ended: see `Environment.take_episode_data`."""
        return self._alive().take_episode_data()

    def track_states(self) -> None:
        """Prepare `get_state` and `set_state`, after `open` if nothing is drawn.

        Raises:
            StateError: If something cannot be captured; it is named.
        """
        self._call("get_state", self._alive().track_state)

    def get_state(self) -> dict[str, Any]:
        """Return what an instance in another process needs to go on with the next row.

        Its next rows have the same bits, as have the next ones here. Where an engine keeps memory
        of its last step, these differ in the last bits from those without a state: take states
        after the same rows in each run.

        Returns:
            A value that `physx_core.net.encode` takes, which later steps do not change.

        Raises:
            StateError: If something cannot be captured; it is named.
            EnvironmentFailedError: If the environment raises.
        """
        environment, rejected = self._alive(), self.rejected
        if self._refusal is not None:
            raise self._refusal
        self._check_tasks()
        return {
            "environment": self._call("get_state", environment.get_state),
            "place": environment.get_place(),
            "instance": {name: getattr(self, name) for name in _COUNTERS},
            "hand": None if self._hand is None else self._hand.get_state(),
            "rejected": None if rejected is None else list(rejected.waiting),
            "drawing": None if self._drawing is None else self._drawing.capture(),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on from the state of an instance with the same arguments.

        Raises:
            StateError: If the environment was created differently.
            EnvironmentFailedError: If the environment raises.
        """
        environment = self._alive()
        self._call("set_state", environment.set_state, state["environment"])
        environment.set_place(state["place"])
        for name in _COUNTERS:
            setattr(self, name, state["instance"][name])
        if self._hand is not None and state.get("hand") is not None:
            self._hand.set_state(state["hand"])
        if self.rejected is not None:
            self.rejected.waiting = list(state["rejected"] or [])
        if self._drawing is not None and state["drawing"] is not None:
            self._drawing.restore(state["drawing"])

    def fork(self) -> Instance:
        """Return an independent copy that goes on from here: see `Environment.fork`.

        It records no rejected samples, and draws nothing. Close it.

        Raises:
            StateError: If something cannot be captured; it is named.
            EnvironmentFailedError: If the environment raises.
        """
        if self._refusal is not None:
            raise self._refusal
        self._check_tasks()
        fork = copy.copy(self)
        fork.environment = environment = self._call("fork", self._alive().fork)
        fork._simulate = fork._simulate_sub_steps if self._sub_steps else environment.step
        fork.rejected = None if self.rejected is None else RejectedSamples()
        fork._draws, fork._drawing, fork._runner, fork._hand = False, None, None, None
        return fork

    def _check_tasks(self) -> None:
        """Check that no task waits in the event loop."""
        if self._runner is not None:
            import asyncio

            for task in asyncio.all_tasks(self._runner.get_loop()):
                text = f"step() has left {task!r:.80} running, so there can be no state."
                raise StateError(text, task.get_name(), "asyncio.Task")

    def apply(self, prediction: Sample) -> None:
        """Pass a prediction in physical units to the environment.

        Raises:
            EnvironmentFailedError: If the environment raises.
        """
        environment = self._alive()
        self._call("apply_prediction", environment.apply_prediction, PredictedFields(prediction))
        self._show(environment)

    def close(self) -> None:
        """Close the environment; further calls do nothing.

        Raises:
            EnvironmentFailedError: If the environment raises.
        """
        environment, self.environment, self._simulate = self.environment, None, self._alive
        try:
            if environment is not None:
                self._call("close", environment.close)
        finally:
            if self._runner is not None:
                self._runner.close()
                self._runner = None

    def _prepare(self, environment: Environment, stored: Sample | None) -> bool:
        """Give the environment a stored row and its parameters, or begin its next episode.

        Returns:
            Whether there is an episode to go on with; if not, `begin` begins the next one.
        """
        environment.sample = stored
        if stored is not None and SET in stored:
            self._replay(environment, stored)
        if environment._episode_is_over:
            if self._is_numbered:
                return False
            self._begin_episode(environment)
        self._counts = stored is not None or self._episode_steps is not None
        return True

    def _begin_episode(self, environment: Environment) -> None:
        self._rows = 0
        self._call("reset_parameters", environment.begin_episode, self._next_episode)
        self._next_episode = environment.episode_index + 1

    def _replay(self, environment: Environment, stored: Sample) -> None:
        """Give the environment a stored row, and the parameters that it was generated with."""
        values = {name: stored[name] for name in stored if name.startswith(PARAMETER)}
        environment.sample = {name: stored[name] for name in stored if name not in values}
        place = int(values.pop(SET))
        if place >= 0 and environment._defined_parameters:
            values = {name.removeprefix(PARAMETER): values[name] for name in values}
            self._call("reset_parameters", environment.replay_episode, place, values)

    def _count(self, environment: Environment) -> None:
        """Count a row of an episode, which may be its last, and check that a stored row is read."""
        if environment._sample is not None and not environment._has_read_sample:
            raise UsageError(
                f"{type(environment).__name__} never reads Environment.sample, so it generates "
                "new samples instead of replaying the stored ones. In step(), take the state from "
                "self.sample (field name to array) if it is not None."
            )
        self._rows += 1
        if self._rows == self._episode_steps:
            environment.end_episode()

    def _accepts(self, accepted: Any) -> bool:
        """Return whether a sample counts if `check_sample` returned something else than True."""
        if accepted is None:
            error = UsageError("check_sample() returned None but must return True or False.")
            raise self._failure("check_sample", error)
        return bool(accepted) or self._accepts_all

    def _simulate_sub_steps(self) -> Any:
        """Run the sub-steps, and return the result of the step that generates the sample."""
        environment = self._alive()
        environment.compute_training_data = False
        for _ in range(self._sub_steps):
            self._finish(environment.step())
        environment.compute_training_data = True
        return environment.step()

    def _show(self, environment: Environment) -> None:
        """Send what the environment drew and did not send itself."""
        if environment.factory.has_events:
            environment.update_visualization()

    def _reject(self, sample: dict[str, Any], wrong: int) -> None:
        """Record a rejected sample, the `wrong`-th in a row; raise if there are too many."""
        if self._hand is not None:
            self._hand.repeat()
        if self.rejected is not None and not self._is_numbered:
            self.rejected.add(sample, self.last_episode, self.last_step)
        elif self.rejected is not None and not self.rejected.has(self.last_episode, MOST_REJECTED):
            steps = self._alive()._earlier_steps
            self.rejected.add(sample, self.last_episode, self.last_step - steps)
        if wrong > self._max_wrong_samples:
            raise WrongSamplesError(
                f"check_sample() rejected {wrong} samples in a row; "
                f"max_wrong_samples_per_step is {self._max_wrong_samples}.",
                instance_id=0 if self._is_numbered else self.instance_id,
                step=self.last_step,
            )

    def _note_empty(self, environment: Environment, count: int) -> None:
        """Check how many episodes in a row ended without a row."""
        if self._hand is not None:
            self._hand.repeat()
        if count == _MOST_EMPTY:
            raise UsageError(
                f"{type(environment).__name__} ended {count} episodes in a row without a row: call "
                "set_training_data() in the step that calls end_episode()."
            )

    def _finish(self, result: Any) -> None:
        """Run the coroutine that `step` returned, if it is one."""
        if inspect.iscoroutine(result):
            if self._runner is None:
                import asyncio

                self._runner = asyncio.Runner()
            self._runner.run(result)

    def _call(self, method: str, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except Exception as error:
            raise self._failure(method, error) from error

    def _failure(self, method: str, error: BaseException) -> BaseException:
        """Return the error to raise: physx errors get a note, others are wrapped.

        An environment that exits fails its episode, but ends a stream.
        """
        exits = isinstance(error, SystemExit)
        if exits and not (self._is_numbered and is_ending(error)):
            return error
        environment = self.environment
        if environment is None or method not in _STEPPING:
            step = -1
        else:
            step = environment.step_index if self._is_numbered else environment._step_count
        place = own_line(error)
        if isinstance(error, PhysxError):
            if method != "import":
                at = f", at {place}" if place else ""
                error.add_note(f"in {method}() of instance {self.instance_id}{at}")
            return error
        summary = "".join(traceback.format_exception_only(error)).strip()
        if exits:
            summary = describe_ending(error)
        if isinstance(error, AttributeError):
            hint = explain_missing_attribute(error, method)
            summary += f".{hint}" if hint else ""
        if place:
            summary += f" ({place})"
        text = "".join(traceback.format_exception(error))
        return EnvironmentFailedError(self.instance_id, method, step, summary, text)

    def _alive(self) -> Environment:
        if self.environment is None:
            raise UsageError(f"Instance {self.instance_id} is not open.")
        return self.environment
