"""Environment: base class of the user's simulations, which generate samples."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from physx_core.closeable import Closeable
from physx_core.components.parameter import Parameter, as_parameters, draw, random_of
from physx_core.components.sampler import checked
from physx_core.components.scene.factory import Factory, NullFactory
from physx_core.components.services import Aside, Choose, Services, SharedChoice
from physx_core.errors import (
    ConfigError,
    MissingFieldError,
    NotFiniteError,
    SampleError,
    UnknownOptionError,
    UsageError,
    listed,
    nearest,
)
from physx_core.fields import NO_ARRAY, Field, FieldLike, as_fields, is_finite
from physx_core.random_streams import NumberedStreams
from physx_core.rows import check_names, infer_shapes
from physx_core.typing import Array, Sample

if TYPE_CHECKING:
    from physx_core.states import Baseline

_OTHER_NAMES = {
    "sample_training": "sample",
    "sample_additional": "sample",
    "set_additional_dataset": "set_additional_data()",
    "define_training_data": "define_training_fields()",
    "define_additional_data": "define_additional_fields()",
    "get_database_handler": "set_training_data()",
    "update_line": "set_training_data()",
    "render": "Environment.update_visualization()",
}
"""Attributes of other systems' environments and factories, and their equivalents here."""


_COUNTERS = (
    "step_index",
    "episode_index",
    "sample_episode",
    "_has_read_sample",
    "_has_begun_episodes",
    "_episode_is_over",
    "_earlier_steps",
    "_replayed",
)
"""What changes about the place of an environment in its run; instances keep it."""
_OF_THE_RUN = (
    *("factory", "step_time", "compute_training_data", "_sample", "_training", "_additional"),
    *("_services", "_choose_parameters", "_baseline", "_made_with", "_loaded", "_has_kept"),
    *("_controls", "_control_values", "_pulls"),
)
"""What an environment has from its run, for viewers, or only within a step."""


class PredictedFields(dict[str, Array]):
    """A network's prediction for one sample: arrays by the names in `Network.pred_fields`.

    A single field is also available under the name ``prediction``.
    """

    def __missing__(self, name: str) -> Array:
        if name == "prediction" and len(self) == 1:
            return next(iter(self.values()))
        raise MissingFieldError(
            f'the network does not predict "{name}".{nearest(name, self)} It predicts: '
            f"{listed(self)}.",
            field=name,
        )


def not_finite_prediction(name: str) -> NotFiniteError:
    """Return the error for a prediction that contains NaN or infinity."""
    return NotFiniteError(
        f'the network\'s prediction "{name}" holds NaN or infinity, although its inputs are '
        "finite. Train the network again, with normalized data or a smaller learning rate.",
        field=name,
    )


class Environment(Closeable):
    """A simulation that generates one sample in each step.

    Subclasses implement `create`, `init_database` and `step`. The methods are called in this
    order: `create`, `init`, `init_database`, `init_visualization` (only with a visualizer),
    `reset_parameters` (only if parameters are defined, or episodes are independent), then `step`
    repeatedly, and `close` at the end, even after a failure.

    An environment is a stream, in which each row may depend on all before it, unless it says that
    its episodes are independent: then nothing but an episode's number, with its parameters and its
    random stream, may influence its rows, and any instance may simulate it.

    Attributes:
        independent_episodes: Whether the episodes are independent; each ends with `end_episode`,
            or after `episode_steps` rows.
        episode_steps: Class attribute: number of rows of an episode, which is then independent; 1
            if each step is a simulation of its own. None: `end_episode` ends it.
        instance_id: Number of this instance among all instances of the run, from 1.
        instance_nb: Number of instances in the run.
        factory: Draws the environment. Without a visualizer it accepts everything, does nothing,
            and is false: ``if self.factory:`` skips work that only drawing needs.
        compute_training_data: False in sub-steps whose data is not used.
        step_index: Number of finished steps; if episodes are independent, of this one.
        episode_index: Index of the current trajectory, from 0.
        sample_episode: Index of the trajectory of the last training data.
        runs_programs: Whether arguments name programs to run; then no file may supply them.
        constants: Class attribute: names of attributes that states leave out: see `get_state`.
        step_time: Simulated time of a step, in s; None, the default: unknown. Viewers play what is
            drawn in simulated time; if the times of steps differ, call `Factory.set_time` instead.
    """

    constants: ClassVar[tuple[str, ...]] = ()
    step_time: float | None = None
    runs_programs: ClassVar[bool] = False
    independent_episodes: bool = False
    episode_steps: int | None = None
    _has_seed: bool | None = None  # until the constructor has run
    _made_with: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Note the arguments, for `fork`."""
        made = super().__new__(cls)
        made._made_with = args, kwargs
        return made

    def __init__(
        self,
        *,
        instance_id: int = 1,
        instance_nb: int = 1,
        seed: int | Sequence[int] | None = None,
        **kwargs: Any,
    ) -> None:
        """Set the instance's identity and random stream.

        Args:
            instance_id: Number of this instance, from 1.
            instance_nb: Number of instances in the run.
            seed: Seed of the run; each instance has its own stream.
            kwargs: Must be empty; a subclass takes its own options by name.

        Raises:
            UnknownOptionError: If no class of the environment takes an option.
        """
        if kwargs:
            raise UnknownOptionError(type(self).__name__, kwargs, options_of(type(self)))
        self.instance_id = instance_id
        self.instance_nb = instance_nb
        self._seed_entropy: Any = np.random.SeedSequence(seed).entropy
        self.factory: Factory = NullFactory()
        self.compute_training_data = True
        self.step_index = 0
        self.episode_index = 0
        self.sample_episode = 0
        self.independent_episodes |= type(self).episode_steps is not None
        self._has_seed = seed is not None
        self._has_read_sample = False
        self._sample: Sample | None = None
        self._fields: dict[str, Field] = {}
        self._episode_fields: dict[str, Field] = {}
        self._episode_data: dict[str, Array] = {}
        self._has_open_shapes = False
        self._training: dict[str, Any] | None = None
        self._additional: dict[str, Any] | None = None
        self._services: Services | None = None
        self._loaded: list[dict[str, Any]] = []  # parameters, while it was created
        self._has_kept = False  # parameters in the run
        self._defined_parameters: list[Parameter] = []
        self._controls: list[Parameter] = []
        self._control_values: dict[str, Any] = {}
        self._pulls: list[str] = []
        self._choose_parameters: Choose | None = None
        self._has_begun_episodes = False
        self._episode_is_over = True  # there is no episode that a step can continue
        self._earlier_steps = 0  # of the episodes before this one
        self._numbering = instance_id - 1, instance_nb  # of episodes: the first, and the distance
        self._replayed: tuple[int, dict[str, Any]] | None = None  # index of a set, and its values
        self._baseline: Baseline | None = None

    # What a subclass implements -------------------------------------------------------------

    def create(self) -> None:
        """Create the simulation; not needed if `reset_parameters` sets the whole state."""
        if type(self).reset_parameters is Environment.reset_parameters:
            raise self._lacks("create")

    def init(self) -> None:
        """Initialize the simulation once it is created."""

    def init_database(self) -> None:
        """Define the fields with `define_training_fields` and `define_additional_fields`."""
        raise self._lacks("init_database")

    def init_visualization(self) -> None:
        """Add objects to `factory`.

        Called before the first `reset_parameters`: what that sets is drawn by the first step.
        """

    def reset_parameters(self, **values: Any) -> None:
        """Prepare the next episode with these values of the defined parameters.

        Called before the first step of each independent episode, without values if no parameters
        are defined. In a stream, called before the first step and by `new_episode` if
        `define_parameters` was called. Just before the call, `rng` is set to the random stream of
        this episode: if this method sets the whole state, the episode depends on nothing that came
        before it.

        When stored samples are replayed, these are the values that the sample was generated with.
        The method is then called for each sample whose episode differs from the previous one's, and
        `rng` is not reseeded.

        Args:
            values: A number for each parameter of shape ``()``, else an array.
        """
        if values or not self.independent_episodes:
            raise self._lacks("reset_parameters")

    def step(self) -> Any:
        """Simulate one step and set its data with `set_training_data`; may be a coroutine."""
        raise self._lacks("step")

    def check_sample(self) -> bool:
        """Return whether to keep the step's sample."""
        return True

    def apply_prediction(self, prediction: Sample) -> None:
        """Use the network's prediction, in physical units, in the simulation."""

    def perturb(self, **values: Any) -> None:
        """Change something between two steps, as `Branch` does in one of two futures.

        By default, attributes that are numbers, texts or arrays get new values; arrays in place. A
        subclass overrides it for what is no attribute, such as a push, or a mass in an engine.

        Args:
            values: New values by name.

        Raises:
            UsageError: If there is no such attribute, or the value does not fit.
        """
        for name, value in values.items():
            set_number(self, name, value)

    def pull(self, name: str, node: int, force: Array) -> None:
        """Pull at a drawn object, as a person does in a viewer: see `define_controls`.

        Called before each row while it is pulled, and with a force of zero once it is let go.

        Args:
            name: Name of the object.
            node: Index of the vertex of a mesh, of the point, or of a robot's body; else 0.
            force: In the world's frame, in N, shape (3,).
        """
        raise self._lacks("pull")

    def get_state(self) -> Any:
        """Return everything that `set_state` needs to go on exactly from here, between two steps.

        By default, that is what has changed in the attributes since the environment was created,
        but for those that a class names in `constants`: see `physx_core.states.Baseline`. Not part
        of it are variables of modules and classes, global random numbers, open files, threads and
        other processes; ``physx check`` compares the rows that follow with those of an
        environment that gets the state in another process.

        Returns:
            Numbers, strings, bytes, NumPy arrays, and lists, tuples and dictionaries of those,
            which later steps do not change.

        Raises:
            StateError: If an attribute cannot be captured; it is named.
            UsageError: If `track_state` was not called.
        """
        return self._tracked().capture()

    def set_state(self, state: Any) -> None:
        """Return to a state of this environment, or of one in another process that is alike.

        Called after `create`, `init` and `init_database`. Implement it together with `get_state`.
        The counters of steps and episodes, and `rng`, are restored in any case.

        Args:
            state: What `get_state` has returned.

        Raises:
            StateError: If this environment was created differently.
        """
        self._tracked().restore(state)

    def fork(self) -> Self:
        """Return an independent copy that goes on from here, in this process; close it.

        It is a new object of the same class and arguments, for which `create`, `init` and
        `init_database` were called, with the state of this one. Its steps have the same bits as
        those of this one, and influence nothing here: what it saves stays in it, and it draws
        nothing; predictions come from the same network. To look ahead, call its `step`, then
        `take_sample` for what that has set; count in its `step_index` if `step` uses that.
        `Instance.fork` does so.

        Raises:
            StateError: If an attribute cannot be captured; it is named.
            UsageError: If `track_state` was not called right after creation.
        """
        state, (args, kwargs) = self.get_state(), self._made_with
        copy = type(self)(*args, **kwargs)
        copy.independent_episodes = self.independent_episodes
        if self._choose_parameters is not None:
            self._choose_parameters = SharedChoice.of(self._choose_parameters)
        aside = Aside(self._services, self._loaded)
        copy._services, copy._choose_parameters = aside, self._choose_parameters
        try:
            copy.create()
            copy.init()
            copy.init_database()
            copy.track_state()
            if self._has_kept and self._services is not None:
                aside.saved[self._saves_as] = self._services.load_parameters(self._saves_as)
            copy.set_state(state)
            copy.set_place(self.get_place() | {"chosen": {}})
        except BaseException:
            copy.close()
            raise
        copy.compute_training_data, copy._sample = self.compute_training_data, self._sample
        return copy

    def close(self) -> None:
        """Free the resources that `create` acquired."""

    # What a subclass calls ------------------------------------------------------------------

    @functools.cached_property
    def rng(self) -> np.random.Generator:
        """The random number generator of this instance.

        In a stream it has a stream of its own, and with parameters one for each episode. If
        episodes are independent, each has one, and the steps before the first episode another,
        which is the same in every instance.
        """
        if self._has_seed is None:  # the constructor has not run
            name = type(self).__name__
            raise AttributeError(f"{name!r} object has no attribute 'rng'", name="rng", obj=self)
        if self.independent_episodes:
            return self._episode_streams.generator
        spawned = np.random.SeedSequence(self._seed_entropy, spawn_key=(self.instance_id - 1,))
        return np.random.default_rng(spawned)

    @functools.cached_property
    def _episode_streams(self) -> NumberedStreams:
        return NumberedStreams(self._seed_entropy)

    @property
    def sample(self) -> Sample | None:
        """The stored row to replay, field name to array, or None."""
        self._has_read_sample = True
        return self._sample

    @sample.setter
    def sample(self, stored: Sample | None) -> None:
        self._sample = stored

    @property
    def fields(self) -> list[Field]:
        """The defined fields of rows, in the order of definition."""
        return list(self._fields.values())

    @property
    def episode_fields(self) -> list[Field]:
        """The defined fields of episodes, in the order of definition."""
        return list(self._episode_fields.values())

    def define_training_fields(self, fields: FieldLike | Iterable[FieldLike]) -> None:
        """Define fields that networks read: see `physx_core.fields.as_fields`.

        Raises:
            ConfigError: If a field is malformed, reserved or defined twice.
        """
        self._define(as_fields(fields, "training"))

    def define_additional_fields(self, fields: FieldLike | Iterable[FieldLike]) -> None:
        """Define fields that are stored with the training data, for example to replay a state.

        Raises:
            ConfigError: If a field is malformed, reserved or defined twice.
        """
        self._define(as_fields(fields, "additional"))

    def define_episode_fields(self, fields: FieldLike | Iterable[FieldLike]) -> None:
        """Define fields that an independent episode has once, for example its geometry.

        They are stored in the mode ``episodes``; `set_episode_data` sets them.

        Raises:
            ConfigError: If a field is malformed, reserved or defined twice, or has no shape.
            UsageError: If episodes are not independent.
        """
        given = as_fields(fields, "episode")
        if not self.independent_episodes:
            raise UsageError(
                f"{type(self).__name__} called define_episode_fields(), but is a stream: define "
                "additional fields, which each row has, or set independent_episodes = True if "
                "nothing but an episode's parameters and random stream influences its rows."
            )
        for field in given:
            if field.shape is None:
                raise ConfigError(f'The field "{field.name}" of episodes needs a shape.')
        self._define(given, self._episode_fields)

    def define_parameters(self, parameters: Parameter | Iterable[Parameter]) -> None:
        """Define properties of the simulation that are chosen for each episode.

        Call it in `create` or `init`. The run's sampler (`EnvironmentConfig.sampler`) chooses their
        values, which `reset_parameters` gets; without one they are drawn from their distributions.

        Raises:
            ConfigError: If a parameter is malformed or defined twice.
            UsageError: If the first episode has begun.
        """
        if self._has_begun_episodes:
            raise UsageError(
                "define_parameters() was called after the first step: call it in create()."
            )
        for parameter in as_parameters(parameters):
            if any(known.name == parameter.name for known in self._defined_parameters):
                raise ConfigError(f'The parameter "{parameter.name}" is defined twice.')
            self._defined_parameters.append(parameter)

    def define_controls(
        self,
        controls: Parameter | Iterable[Parameter] = (),
        pulls: Iterable[str] = (),
        **values: Any,
    ) -> None:
        """Define what a person can change while it runs, in a viewer with sliders.

        Call it in `create` or `init`. Without such a viewer nothing happens. With one, `perturb`
        gets new values between two steps, and `pull` is called; each row keeps what was done before
        it in the additional field ``hand``, so `Branch` and reports can simulate it again.

        Args:
            controls: What has a slider, within its bounds; the distribution does not matter, but
                ``integer`` has whole numbers. Attributes of these names have the first values.
            pulls: Names of drawn objects that can be pulled.
            values: First values of controls that are no attributes.

        Raises:
            ConfigError: If a control is malformed or defined twice.
            UsageError: If something can be pulled, but there is no method `pull`.
        """
        for each in as_parameters(controls):
            if any(known.name == each.name for known in self._controls):
                raise ConfigError(f'The control "{each.name}" is defined twice.')
            self._controls.append(each)
        self._pulls += pulls
        self._control_values |= values
        if self._pulls and type(self).pull is Environment.pull:
            raise self._lacks("pull")

    def set_training_data(self, **fields: Any) -> None:
        """Set this step's training data: every training field, as arrays or numbers."""
        self._training = fields
        self.sample_episode = self.episode_index

    def new_episode(self) -> None:
        """Start a new trajectory, which does not continue the previous data.

        Call it when the state jumps, for example after drawing a new motion; the first trajectory
        starts automatically. Rows keep its index in the field ``episode``, from which
        `Dataset.episodes` recovers the trajectories. If there are parameters, the next values are
        chosen and `reset_parameters` is called.

        Raises:
            UsageError: If episodes are independent.
        """
        if self.independent_episodes:
            raise UsageError(
                f"{type(self).__name__} has independent episodes, but called new_episode(), which "
                "is for streams: call end_episode() in the last step of an episode. The next one "
                "begins with reset_parameters()."
            )
        self.episode_index += 1
        if self._has_begun_episodes and self._defined_parameters:
            self._reset_with_parameters()

    def end_episode(self) -> None:
        """End this independent episode with the row of this step, or before it if it sets no data.

        In a replay of stored samples, which may be of many episodes, this does nothing.

        Raises:
            UsageError: If episodes are not independent.
        """
        if not self.independent_episodes:
            raise UsageError(
                f"{type(self).__name__} called end_episode(), but is a stream: call new_episode(), "
                "or set independent_episodes = True if nothing but an episode's parameters and "
                "random stream influences its rows."
            )
        self._episode_is_over = self._sample is None

    def set_additional_data(self, **fields: Any) -> None:
        """Set this step's additional data: every additional field, as arrays or numbers."""
        self._additional = fields

    def set_episode_data(self, **fields: Any) -> None:
        """Set fields of this independent episode, all at once or one by one, at any time in it.

        The last value of each counts; its array may be changed afterwards. Where rows are not
        stored with their episode, as in a prediction, this does nothing else than to check them.

        Raises:
            SampleError: If a field is not one of `episode_fields`, of the wrong shape or type, or
                holds NaN or infinity.
            UsageError: If no episode has begun.
        """
        if not self._has_begun_episodes:
            raise UsageError(
                "set_episode_data() was called before the first episode: call it in "
                "reset_parameters() or step()."
            )
        for name, value in fields.items():
            if name not in self._episode_fields:
                check_names(self._episode_fields, [name])
            field = self._episode_fields[name]
            values = np.array(field.convert(value))
            if not is_finite(values):
                raise field.not_finite()
            self._episode_data[name] = values

    def get_prediction(self, **fields: Any) -> Sample:
        """Return the network's prediction within a step, in physical units.

        Args:
            fields: The network's input fields; if none are given, this step's training data.

        Raises:
            UsageError: If the run has no network, or there are no training data yet.
            SampleError: If a field does not fit the network, or one of its inputs or predictions
                contains NaN or infinity.
        """
        if not fields and self._training is None:
            raise UsageError("Call set_training_data() before get_prediction() without fields.")
        if self._has_open_shapes:
            self._infer_shapes()
        inputs = fields or dict(self._training or {})
        try:
            for name, value in inputs.items():
                if not _is_finite(value):
                    text = f'get_prediction() got the field "{name}" with NaN or infinity'
                    raise NotFiniteError(f"{text}.", field=name)
            prediction = PredictedFields(self._run().predict(inputs))
            for name, value in prediction.items():
                if not _is_finite(value):
                    raise not_finite_prediction(name)
        except SampleError as error:
            raise error.at(self.instance_id, self._step_count) from None
        return prediction

    def _infer_shapes(self) -> None:
        """Infer undefined shapes of fields from this step's data."""
        given = {**(self._training or {}), **(self._additional or {})}
        self._fields = {field.name: field for field in infer_shapes(self.fields, given)}
        self._has_open_shapes = any(field.shape is None for field in self._fields.values())

    def save_parameters(self, **values: Any) -> None:
        """Save numbers, strings, lists, dictionaries and arrays of this instance in the dataset.

        If episodes are independent, all instances have the same: the first one saves them, and
        what others save must be equal.

        Raises:
            UsageError: If another instance has saved another value, or an independent episode has
                begun.
        """
        if self.independent_episodes and self._has_begun_episodes:
            raise UsageError(
                f"{type(self).__name__} called save_parameters() in an independent episode: call "
                "it in create() or init(), and set what belongs to an episode with "
                "set_episode_data()."
            )
        self._has_kept = True
        self._run().save_parameters(self._saves_as, values)

    def load_parameters(self) -> dict[str, Any]:
        """Return the values that this instance saved with `save_parameters`, if any."""
        loaded, self._has_kept = self._run().load_parameters(self._saves_as), True
        if not self._has_begun_episodes:
            self._loaded.append(loaded)
        return loaded

    @property
    def _saves_as(self) -> int:
        """The instance whose values these are; 0: all of them."""
        return 0 if self.independent_episodes else self.instance_id

    def update_visualization(self) -> None:
        """Send the drawing events that `factory` collected since the last call to the viewers.

        physx calls it after `step` and `apply_prediction`; call it to show more in between.
        """
        if self.factory:
            steps = self._step_count
            if self.step_time is not None:
                self.factory.set_time(steps * self.step_time)
            self._run().show(self.instance_id, steps, self.factory.take_events())

    @property
    def _step_count(self) -> int:
        """Number of finished steps of all episodes of this instance."""
        return self._earlier_steps + self.step_index

    def track_state(self) -> None:
        """Prepare the default `get_state`, right after creation.

        physx calls it if the run takes states. An environment that forks itself calls it at the end
        of `init_database`.

        Raises:
            StateError: If an attribute cannot be captured; it is named.
            UsageError: If it defines only one of `get_state` and `set_state`.
        """
        kind, methods = type(self), ("get_state", "set_state")
        own = [name for name in methods if getattr(kind, name) is not getattr(Environment, name)]
        if len(own) == 1:
            raise UsageError(f"{kind.__name__} defines {own[0]}(), but needs both: {methods}.")
        if not own:
            from physx_core.states import Baseline  # most runs take no states

            _ = self.rng  # which is created on first use
            self._baseline = Baseline(self, [*_OF_THE_RUN, *_COUNTERS, *_constants_of(kind)])

    def leave_out_of_state(self, names: Iterable[str]) -> None:
        """Leave attributes out that only viewers need; physx calls it."""
        if self._baseline is not None:
            self._baseline.leave_out(names)

    def _tracked(self) -> Baseline:
        if self._baseline is None:
            raise UsageError(
                f"There is no state of {type(self).__name__} by default, because it has methods of "
                "its own for it, or track_state() was not called right after creation: call it at "
                "the end of init_database()."
            )
        return self._baseline

    def get_place(self) -> dict[str, Any]:
        """Return the counters and the state of `rng`, which are not in `get_state`."""
        place = {name: getattr(self, name) for name in _COUNTERS}
        from physx_core.states import as_lists

        chosen = getattr(self._choose_parameters, "chosen", {})  # by forks that are ahead
        place["chosen"] = {n: dict(each) for n, each in chosen.items() if n > self.episode_index}
        return {**place, "rng": as_lists(self.rng.bit_generator.state)}

    def set_place(self, place: Mapping[str, Any]) -> None:
        """Set what `get_place` returned."""
        for name in _COUNTERS:
            setattr(self, name, place[name])
        if place["chosen"] and self._choose_parameters is not None:
            self._choose_parameters = SharedChoice(self._choose_parameters, place["chosen"])
        self.rng.bit_generator.state = place["rng"]

    def begin_episode(self, episode: int | None = None) -> None:
        """Begin the first episode of a stream, or any independent one; physx calls it.

        Args:
            episode: Index of the episode; None: the environment decides.
        """
        if self.independent_episodes:
            self._earlier_steps, self.step_index = self._step_count, 0
        self._has_begun_episodes, self._episode_is_over = True, False
        if self._defined_parameters or self.independent_episodes:
            self.episode_index = self.episode_index if episode is None else episode
            self._reset_with_parameters()

    def begin_number(self, number: int, values: Mapping[str, Any]) -> None:
        """Begin an independent episode with its parameters, after any other; physx calls it.

        Args:
            number: Number of the episode in its campaign.
            values: The values of the parameters.
        """
        self._earlier_steps += self.step_index
        self.step_index, self.episode_index = 0, number
        self._has_begun_episodes, self._episode_is_over = True, False
        self._episode_data = {}
        self._check_generator()
        self._episode_streams.seek(number)
        self.reset_parameters(**values)

    def replay_episode(self, place: int, values: Mapping[str, Any]) -> None:
        """Prepare the episode of a stored row with its parameters; physx calls it before the step.

        Does nothing if the previous row was of the same set.

        Args:
            place: Index of the set in the dataset's record.
            values: The values of the parameters.

        Raises:
            ConfigError: If they are not the defined parameters.
        """
        self._has_begun_episodes, self._episode_is_over = True, False
        if self._replayed is None or self._replayed[0] != place:
            try:
                self._replayed = place, checked(self._defined_parameters, values)
            except ConfigError as error:
                raise ConfigError(
                    f"The stored samples cannot be replayed with the parameters that they were "
                    f"generated with: {error}"
                ) from error
            self._reset_with_parameters()

    def _reset_with_parameters(self) -> None:
        """Get the parameters of the current episode, if any, and prepare it with them.

        In a replay they are those of the stored row, and `rng` is not reseeded, because rows of an
        episode may come one by one.
        """
        if self._replayed is not None:
            self.reset_parameters(**self._replayed[1])
            return
        first, distance = self._numbering
        number = first + self.episode_index * distance
        values: Mapping[str, Any] = {}
        if self._defined_parameters and self._choose_parameters is not None:
            values = self._choose_parameters(self.episode_index)
        elif self._defined_parameters:
            values = draw(self._defined_parameters, self._seed_entropy, number)
        if self.independent_episodes:
            self._check_generator()
            self._episode_streams.seek(number)
        else:
            fresh = random_of(self._seed_entropy, number, 0).bit_generator.state
            self.rng.bit_generator.state = fresh  # in place: others may hold the generator
        self.reset_parameters(**values)

    def _check_generator(self) -> None:
        """Check that the numbers of an independent episode come from its random stream."""
        if self.rng is not self._episode_streams.generator:
            raise UsageError(
                f"{type(self).__name__} has replaced self.rng, but its episodes are independent: "
                "the numbers of an episode must come from the generator that physx sets."
            )

    def _lacks(self, method: str) -> UsageError:
        own = [name for name in dir(type(self)) if not hasattr(Environment, name)]
        return UsageError(
            f"{type(self).__name__} does not implement {method}().{nearest(method, own)}"
        )

    def _define(self, fields: list[Field], known: dict[str, Field] | None = None) -> None:
        for field in fields:
            if field.name in self._fields or field.name in self._episode_fields:
                raise ConfigError(f'The field "{field.name}" is defined twice.')
            (self._fields if known is None else known)[field.name] = field
            self._has_open_shapes |= field.shape is None

    def _run(self) -> Services:
        if self._services is None:
            raise UsageError("This environment is not part of a run yet.")
        return self._services

    def take_sample(self) -> dict[str, Any] | None:
        """Return and clear this step's data by field name; None if the episode ended before it.

        Raises:
            MissingFieldError: If the step did not set any training data.
        """
        sample, additional = self._training, self._additional
        if sample is None:
            if self._episode_is_over and self._has_begun_episodes:
                return None
            raise MissingFieldError(
                "step() did not set any data: call set_training_data() in every step.",
                instance_id=self.instance_id,
                step=self._step_count,
            )
        self._training = self._additional = None
        return sample if additional is None else {**sample, **additional}

    def take_episode_data(self) -> dict[str, Array]:
        """Return the fields of the episode that has ended.

        Raises:
            MissingFieldError: If one was not set.
        """
        for name in self._episode_fields:
            if name not in self._episode_data:
                text = f'field "{name}" of the episode was not set: call set_episode_data() before'
                raise MissingFieldError(f"{text} it ends.", field=name)
        return self._episode_data


def _is_finite(value: Any) -> bool:
    try:
        return is_finite(np.asarray(value))
    except NO_ARRAY:  # the network reports what is wrong
        return True


def set_number(of: Any, name: str, value: Any) -> None:
    """Change an attribute of an object that is a number, a text or an array.

    Args:
        of: The object.
        name: The attribute.
        value: Its value; arrays keep shape and type.

    Raises:
        UsageError: If there is no such attribute, or the value does not fit.
    """
    own = Environment.__annotations__.keys() | vars(Environment()).keys()
    known = [
        each for each, held in vars(of).items()
        if not each.startswith("_") and each not in own
        and isinstance(held, (int, float, str, np.number, np.ndarray))
    ]  # fmt: skip
    place = getattr(type(of), name, None)
    if name not in known and getattr(place, "fset", None) is None:
        raise UsageError(
            f"{type(of).__name__} has no {name} that could be set. It has "
            f"{listed(known) or 'nothing'}; perturb() may take more."
        )
    held = getattr(of, name)
    try:
        if isinstance(held, np.ndarray):
            held[...] = np.asarray(value, held.dtype)
            return
    except (TypeError, ValueError):
        raise UsageError(
            f"{name} has the shape {held.shape} and the type {held.dtype}; {value!r} does not fit."
        ) from None
    if isinstance(held, str) is not isinstance(value, str) or not np.isscalar(value):
        raise UsageError(f"{name} is {held!r}; {value!r} does not fit.")
    setattr(of, name, value)


def _constants_of(kind: type[Environment]) -> list[str]:
    given = [vars(each).get("constants", ()) for each in kind.__mro__]
    if any(isinstance(each, str) for each in given):
        raise UsageError(f'{kind.__name__}.constants must be a tuple: constants = ("name",).')
    return [name for names in given for name in names]


def explain_missing_attribute(error: AttributeError, method: str) -> str:
    """Return a hint for an attribute that an environment or its factory does not have.

    Args:
        error: The error.
        method: The environment's method that raised it.
    """
    owner, name = error.obj, str(error.name)
    if not isinstance(owner, (Environment, Factory)):
        return ""
    if isinstance(owner, Environment) and owner._has_seed is None:
        return f" {type(owner).__name__}.__init__() must first call super().__init__(**kwargs)."
    if name in _OTHER_NAMES:
        return f" Use {_OTHER_NAMES[name]} instead."
    resets = type(owner).reset_parameters if isinstance(owner, Environment) else None
    if method == "init_visualization" and resets not in (None, Environment.reset_parameters):
        return (
            " reset_parameters() is called later: add objects here with any values, and change "
            "them in step()."
        )
    own = dir(type(owner)) if isinstance(owner, Factory) else [*dir(type(owner)), *vars(owner)]
    return nearest(name, (known for known in own if not known.startswith("_")))


def options_of(cls: type[Any]) -> list[str]:
    """Return the option names of the constructors of a class and its bases."""
    names: dict[str, None] = {}
    for base in cls.__mro__:
        if "__init__" not in vars(base):
            continue
        for name, parameter in inspect.signature(vars(base)["__init__"]).parameters.items():
            plain = parameter.kind in (parameter.KEYWORD_ONLY, parameter.POSITIONAL_OR_KEYWORD)
            if plain and name not in ("self", "instance_id", "instance_nb", "seed"):
                names[name] = None
    return list(names)
