"""Environment: the user's code that makes samples."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np

from physx_core.components.scene import Event, Factory
from physx_core.errors import ConfigError, UnknownFieldError, UnknownOptionError, UsageError
from physx_core.fields import Field, FieldLike, as_fields
from physx_core.typing import Sample


class Services(Protocol):
    """What an environment may ask of the run that it belongs to."""

    def predict(self, fields: Sample) -> Sample:
        """Return the network's prediction for one sample, in physical units."""
        ...

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Keep values of one instance for later runs on the same dataset."""
        ...

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return the values that one instance kept; empty where it kept none."""
        ...

    def show(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Hand drawing events to the viewers."""
        ...


class Environment:
    """A simulation that makes one sample in each step.

    Subclasses implement `create`, `init_database` and `step`. The methods are called in this
    order: `create`, `init`, `init_database`, `init_visualization` (only with a visualizer), then
    `step` again and again, and `close` at the end, after a failure too.

    Attributes:
        instance_id: Number of this instance among those that run together, counted from 1.
        instance_nb: How many instances run together.
        rng: This instance's own stream of random numbers.
        factory: Draws the environment; None where no visualizer looks on.
        compute_training_data: False in the sub-steps whose data nobody reads.
        step_index: Number of steps that were finished before the present one.
        episode_index: Number of the present trajectory, counted from 0.
        sample_episode: Number of the trajectory that the last training data belong to.
        sample: A stored row that the environment shall replay, or None.
    """

    def __init__(
        self,
        *,
        instance_id: int = 1,
        instance_nb: int = 1,
        seed: int | Sequence[int] | None = None,
        **kwargs: Any,
    ) -> None:
        """Keep what identifies the instance.

        Args:
            instance_id: Number of this instance, counted from 1.
            instance_nb: How many instances run together.
            seed: Seed of the whole run; each instance draws from a stream of its own.
            kwargs: Must be empty; a subclass takes its own options by name.

        Raises:
            UnknownOptionError: An option that no class of the environment takes.
        """
        if kwargs:
            raise UnknownOptionError(type(self).__name__, kwargs, options_of(type(self)))
        self.instance_id = instance_id
        self.instance_nb = instance_nb
        stream = np.random.SeedSequence(seed, spawn_key=(instance_id - 1,))
        self.rng = np.random.default_rng(stream)
        self.factory: Factory | None = None
        self.compute_training_data = True
        self.step_index = 0
        self.episode_index = 0
        self.sample_episode = 0
        self.sample: Sample | None = None
        self._fields: dict[str, Field] = {}
        self._training: dict[str, Any] | None = None
        self._additional: dict[str, Any] | None = None
        self._services: Services | None = None

    # What a subclass implements -------------------------------------------------------------

    def create(self) -> None:
        """Create the simulation."""
        raise UsageError(f"{type(self).__name__} does not implement create().")

    def init(self) -> None:
        """Initialize the simulation once it is created."""

    def init_database(self) -> None:
        """Define the fields with `define_training_fields` and `define_additional_fields`."""
        raise UsageError(f"{type(self).__name__} does not implement init_database().")

    def init_visualization(self) -> None:
        """Add objects to `factory`."""

    def step(self) -> Any:
        """Simulate one step and give its data with `set_training_data`; may be a coroutine."""
        raise UsageError(f"{type(self).__name__} does not implement step().")

    def check_sample(self) -> bool:
        """Return whether the step's sample is to be kept."""
        return True

    def apply_prediction(self, prediction: Sample) -> None:
        """Use the network's prediction, in physical units, in the simulation."""

    def close(self) -> None:
        """Free what `create` took."""

    # What a subclass calls ------------------------------------------------------------------

    @property
    def fields(self) -> list[Field]:
        """The fields that were defined, in that order."""
        return list(self._fields.values())

    def define_training_fields(self, fields: FieldLike | Iterable[FieldLike]) -> None:
        """Define fields that networks read: see `physx_core.fields.as_fields`.

        Raises:
            ConfigError: A field is malformed, reserved or defined twice.
        """
        self._define(as_fields(fields, "training"))

    def define_additional_fields(self, fields: FieldLike | Iterable[FieldLike]) -> None:
        """Define fields that are stored beside the training data, for example to replay a state.

        Raises:
            ConfigError: A field is malformed, reserved or defined twice.
        """
        self._define(as_fields(fields, "additional"))

    def set_training_data(self, **fields: Any) -> None:
        """Give this step's training data: every training field, as arrays or numbers."""
        self._training = fields
        self.sample_episode = self.episode_index

    def new_episode(self) -> None:
        """Begin a new trajectory: data that are given from now on do not continue those before.

        Call it where the state jumps, for example where a new motion is drawn; the first
        trajectory begins by itself. Rows keep the number in the field ``episode``, so that
        `Dataset.episodes` can cut the trajectories out again.
        """
        self.episode_index += 1

    def set_additional_data(self, **fields: Any) -> None:
        """Give this step's additional data: every additional field, as arrays or numbers."""
        self._additional = fields

    def get_prediction(self, **fields: Any) -> Sample:
        """Return the network's prediction within a step, in physical units.

        Args:
            fields: The network's input fields; without any, this step's training data.

        Raises:
            UsageError: The run has no network, or there are no training data yet.
        """
        if not fields and self._training is None:
            raise UsageError("get_prediction() without fields needs set_training_data() before it.")
        return self._run().predict(fields or dict(self._training or {}))

    def save_parameters(self, **values: Any) -> None:
        """Keep numbers, texts, lists, dictionaries and arrays of this instance with the dataset."""
        self._run().save_parameters(self.instance_id, values)

    def load_parameters(self) -> dict[str, Any]:
        """Return what this instance kept with `save_parameters`; empty where it kept nothing."""
        return self._run().load_parameters(self.instance_id)

    def update_visualization(self) -> None:
        """Send what `factory` collected since the last call to the viewers."""
        if self.factory is not None:
            self._run().show(self.instance_id, self.step_index, self.factory.take_events())

    def _define(self, fields: list[Field]) -> None:
        for field in fields:
            if field.name in self._fields:
                raise ConfigError(f'The field "{field.name}" is defined twice.')
            self._fields[field.name] = field

    def _run(self) -> Services:
        if self._services is None:
            raise UsageError("This environment is not part of a run yet.")
        return self._services

    def take_sample(self) -> dict[str, Any]:
        """Return this step's data by field name and forget them.

        Raises:
            UnknownFieldError: The step gave no training data at all.
        """
        sample, additional = self._training, self._additional
        if sample is None:
            raise UnknownFieldError(
                "step() gave no data: call set_training_data() in every step.",
                instance_id=self.instance_id,
                step=self.step_index,
            )
        self._training = self._additional = None
        return sample if additional is None else {**sample, **additional}


def options_of(cls: type[Any]) -> list[str]:
    """Return the names of all options that the constructors of a class and its bases take."""
    names: dict[str, None] = {}
    for base in cls.__mro__:
        if "__init__" not in vars(base):
            continue
        for name, parameter in inspect.signature(vars(base)["__init__"]).parameters.items():
            plain = parameter.kind in (parameter.KEYWORD_ONLY, parameter.POSITIONAL_OR_KEYWORD)
            if plain and name not in ("self", "instance_id", "instance_nb", "seed"):
                names[name] = None
    return list(names)
