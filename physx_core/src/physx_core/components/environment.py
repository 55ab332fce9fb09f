"""Environment: base class of the user's simulations, which generate samples."""

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
    """Requests that an environment can make to its run."""

    def predict(self, fields: Sample) -> Sample:
        """Return the network's prediction for one sample, in physical units."""
        ...

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Save values of one instance for later runs on the same dataset."""
        ...

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return the values that one instance saved; empty if it saved none."""
        ...

    def show(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Pass drawing events to the viewers."""
        ...


class Environment:
    """A simulation that generates one sample in each step.

    Subclasses implement `create`, `init_database` and `step`. The methods are called in this
    order: `create`, `init`, `init_database`, `init_visualization` (only with a visualizer), then
    `step` repeatedly, and `close` at the end, also after a failure.

    Attributes:
        instance_id: Number of this instance among all instances of the run, from 1.
        instance_nb: Number of instances in the run.
        rng: Random number generator of this instance, with its own stream.
        factory: Draws the environment; None without a visualizer.
        compute_training_data: False in sub-steps whose data are not used.
        step_index: Number of finished steps.
        episode_index: Index of the current trajectory, from 0.
        sample_episode: Index of the trajectory of the last training data.
        sample: The stored row to replay, or None.
    """

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
        """Simulate one step and set its data with `set_training_data`; may be a coroutine."""
        raise UsageError(f"{type(self).__name__} does not implement step().")

    def check_sample(self) -> bool:
        """Return whether to keep the step's sample."""
        return True

    def apply_prediction(self, prediction: Sample) -> None:
        """Use the network's prediction, in physical units, in the simulation."""

    def close(self) -> None:
        """Free the resources that `create` acquired."""

    # What a subclass calls ------------------------------------------------------------------

    @property
    def fields(self) -> list[Field]:
        """The defined fields, in the order of definition."""
        return list(self._fields.values())

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

    def set_training_data(self, **fields: Any) -> None:
        """Set this step's training data: every training field, as arrays or numbers."""
        self._training = fields
        self.sample_episode = self.episode_index

    def new_episode(self) -> None:
        """Start a new trajectory, which does not continue the previous data.

        Call it when the state jumps, for example after drawing a new motion; the first trajectory
        starts automatically. Rows keep its index in the field ``episode``, from which
        `Dataset.episodes` recovers the trajectories.
        """
        self.episode_index += 1

    def set_additional_data(self, **fields: Any) -> None:
        """Set this step's additional data: every additional field, as arrays or numbers."""
        self._additional = fields

    def get_prediction(self, **fields: Any) -> Sample:
        """Return the network's prediction within a step, in physical units.

        Args:
            fields: The network's input fields; if none are given, this step's training data.

        Raises:
            UsageError: If the run has no network, or there are no training data yet.
        """
        if not fields and self._training is None:
            raise UsageError("get_prediction() without fields needs set_training_data() before it.")
        return self._run().predict(fields or dict(self._training or {}))

    def save_parameters(self, **values: Any) -> None:
        """Save numbers, texts, lists, dictionaries and arrays of this instance with the dataset."""
        self._run().save_parameters(self.instance_id, values)

    def load_parameters(self) -> dict[str, Any]:
        """Return the values that this instance saved with `save_parameters`, if any."""
        return self._run().load_parameters(self.instance_id)

    def update_visualization(self) -> None:
        """Send the drawing events that `factory` collected since the last call to the viewers."""
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
        """Return and clear this step's data by field name.

        Raises:
            UnknownFieldError: If the step did not set any training data.
        """
        sample, additional = self._training, self._additional
        if sample is None:
            raise UnknownFieldError(
                "step() did not set any data: call set_training_data() in every step.",
                instance_id=self.instance_id,
                step=self.step_index,
            )
        self._training = self._additional = None
        return sample if additional is None else {**sample, **additional}


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
