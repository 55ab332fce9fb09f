"""ParameterSets: the sets of parameters that a source's environments get."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.components.parameter import SET_FIELDS, Parameter
from physx_core.components.sampler import LearningSampler, checked, checked_many
from physx_core.config import MODES, EnvironmentConfig
from physx_core.errors import (
    ConfigError,
    FieldsMismatchError,
    PhysxError,
    UsageError,
)
from physx_core.fields import Field
from physx_core.plugins import create
from physx_core.typing import Batch
from physx_core.workers.learned_sets import LearnedSets
from physx_core.workers.pasts import NOTHING, Skip
from physx_core.workers.row_queue import RowQueue

_DEFAULT = "physx/uniform"


class ParameterSets:
    """Gets sets from a sampler; those of streams it keeps until the rows of them are stored.

    Set k is for episode k of a campaign, and for trajectory ``k // instance_nb`` of instance
    ``k % instance_nb + 1`` of streams.

    Attributes:
        instance_nb: Number of instances.
        parameters: The parameters that the environment defines.
        learned: The sets of a sampler that learns from a training; None: it does not.
    """

    def __init__(
        self, config: EnvironmentConfig, seed: Sequence[int], skip: Skip = NOTHING
    ) -> None:
        """Create the configured sampler.

        Args:
            config: Names the sampler, and the number of instances.
            seed: Seed of the run.
            skip: What an earlier run already got from streams.
        """
        if config.sampler is None and config.sampler_kwargs:
            raise ConfigError("EnvironmentConfig.sampler_kwargs is given without a sampler.")
        self.parameters: list[Parameter] = []
        self.learned: LearnedSets | None = None
        self._config, self._seed = config, list(seed)
        self.instance_nb = config.num_clients
        self._recorded = skip.sets
        self._sampler = (
            None
            if config.sampler is None
            else create("sampler", config.sampler, config.sampler_kwargs)
        )
        self._waiting: list[dict[int, Mapping[str, Any]]] = [{} for _ in range(self.instance_nb)]
        self._newest: dict[int, Mapping[str, Any]] = {}  # of each instance
        self._begun: list[dict[str, Any]] = []
        self._last_recorded = [-1] * self.instance_nb
        for number, past in skip.pasts.items():
            self._waiting[number - 1].update(past.sets)
            self._newest.update(past.sets)
            self._last_recorded[number - 1] = past.recorded

    def waiting(self, instance_id: int) -> tuple[int, dict[int, Mapping[str, Any]]]:
        """Return what a state of an instance needs: see `Past.recorded` and `Past.sets`."""
        return self._last_recorded[instance_id - 1], dict(self._waiting[instance_id - 1])

    def begin(self, definitions: Sequence[Sequence[Parameter]]) -> None:
        """Take the parameters that the instances define.

        Args:
            definitions: The parameters of each instance.

        Raises:
            ConfigError: If there is a sampler but no parameter, or the sampler cannot choose them.
            FieldsMismatchError: If the instances define different parameters.
        """
        self.parameters = first = list(definitions[0])
        for number, other in enumerate(definitions[1:], 2):
            self.check_same(number, other)
        if not first and self._config.sampler is not None:
            raise ConfigError(
                "EnvironmentConfig.sampler is set, but the environment defines no parameters: "
                "call define_parameters() in its create() and implement reset_parameters(), or "
                "leave sampler out."
            )
        if first:
            self._sampler = self._sampler or create(
                "sampler", _DEFAULT, self._config.sampler_kwargs
            )
            self._sampler.begin(first, self._seed)

    def check_same(self, number: int, other: Sequence[Parameter]) -> None:
        """Check that an instance defines the same parameters as the first one.

        Raises:
            FieldsMismatchError: If not.
        """
        if list(other) == self.parameters:
            return
        mine, theirs = ({p.name: p for p in one} for one in (self.parameters, other))
        raise FieldsMismatchError(
            f"Instances 1 and {number} define different parameters",
            {
                name: f"{mine.get(name, 'not defined')} and {theirs.get(name, 'not defined')}"
                for name in {**mine, **theirs}
                if mine.get(name) != theirs.get(name)
            }
            or {"order": f"{list(mine)} and {list(theirs)}"},
        )

    @property
    def fields(self) -> list[Field]:
        """Fields of the record of the sets."""
        return [*SET_FIELDS, *(parameter.field for parameter in self.parameters)]

    def follow(
        self, queue: RowQueue, needed: Callable[[int], int], batch_nb: int, run_ahead: int
    ) -> None:
        """Make a sampler that learns do so from a training on the rows of a queue's episodes.

        Args:
            queue: The episodes.
            needed: Returns how many rows must have arrived before a batch; never decreases.
            batch_nb: Number of batches of the training.
            run_ahead: How many episodes may be simulated beyond the first missing one.
        """
        if isinstance(self._sampler, LearningSampler) and self.parameters:
            self.learned = LearnedSets(self._sampler, self.parameters, needed, batch_nb, run_ahead)
            queue.choose = self._choose_learned

    def _choose_learned(self, queue: RowQueue, stop: int) -> int:
        assert self.learned is not None
        with self._naming("of the next episode"):
            return self.learned.choose(queue, stop)

    def values_of(self, numbers: range) -> Batch:
        """Return the values of the parameters for episodes of a campaign; empty without any.

        Args:
            numbers: Numbers of the episodes, at least one.

        Returns:
            Name to array of shape (numbers, *parameter's shape).

        Raises:
            ConfigError: If the sampler fails, or what it chooses does not fit the parameters.
        """
        if not self.parameters:
            return {}
        assert self._sampler is not None
        if self.learned is not None:
            sets = [self.learned.values_of(number) for number in numbers]
            return {
                p.name: np.array([one[p.name] for one in sets], p.field.numpy_dtype)
                for p in self.parameters
            }
        self._check_told()
        with self._naming(f"{numbers[0]} and later ones" if len(numbers) > 1 else numbers[0]):
            values = self._sampler.ask_many(numbers[0], len(numbers))
            return checked_many(self.parameters, values, len(numbers))

    def choose(self, instance_id: int, episode: int) -> dict[str, Any]:
        """Return the values of the parameters for a trajectory of an instance.

        Raises:
            ConfigError: If the sampler fails, or what it chooses does not fit the parameters.
            UsageError: If it is too early.
        """
        sampler, number = self._sampler, self._number(instance_id, episode)
        self._check_told()
        if sampler is None or not self.parameters:
            raise UsageError("Parameters can be chosen only once all instances have defined them.")
        with self._naming(number):
            values = checked(self.parameters, sampler.ask(number))
        self._newest.pop(number - self.instance_nb, None)
        self._newest[number] = self._waiting[instance_id - 1][number] = values
        return dict(values)

    def _check_told(self) -> None:
        """Check that the sampler does not learn: it would be told no losses."""
        if isinstance(self._sampler, LearningSampler):
            raise UsageError(
                f"The sampler {type(self._sampler).__name__} learns from training losses on "
                "samples of independent episodes that are generated for the training, but there "
                'are none here. Use "physx/sobol".'
            )

    @contextlib.contextmanager
    def _naming(self, which: int | str) -> Iterator[None]:
        """Raise an error of the sampler as a `ConfigError` that names the sets."""
        try:
            yield
        except PhysxError:
            raise
        except Exception as error:
            name = type(self._sampler).__name__
            raise ConfigError(
                f"The sampler {name} raised for set {which}: {type(error).__name__}: {error}."
            ) from error

    def explain(self, instance_id: int, episode: int, error: PhysxError) -> None:
        """Add to an error with which parameters an instance simulated."""
        number = self._number(instance_id, episode)
        if (values := self._newest.get(number)) is not None:
            text = ", ".join(f"{name}={value}" for name, value in values.items())
            error.add_note(f"The parameters were set {number}: {text}.")

    def _number(self, instance_id: int, episode: int) -> int:
        return episode * self.instance_nb + instance_id - 1

    def note(self, batch: Batch) -> None:
        """Find the sets that begin in a batch of rows, in the order of their first rows."""
        self._begun = []
        if not self.parameters:
            return
        episodes = np.asarray(batch["episode"], np.int64)
        found, first = np.unique(
            episodes * self.instance_nb + batch["env_id"] - 1, return_index=True
        )
        for number in found[np.argsort(first)].tolist():
            place = number % self.instance_nb
            waiting = self._waiting[place]
            for begun in sorted(known for known in waiting if known <= number):
                values, self._last_recorded[place] = waiting.pop(begun), begun
                if begun not in self._recorded:  # by an earlier run
                    self._begun.append(self._record(begun, values))

    def pop(self, mode: str) -> Batch:
        """Return and clear the record of the sets that were found last, field name to array.

        Args:
            mode: Mode of the rows.
        """
        begun, self._begun = self._begun, []
        if not begun:
            return {}
        begun = [{**one, "mode_index": MODES.index(mode)} for one in begun]
        return {
            field.name: np.array([one[field.name] for one in begun], field.numpy_dtype)
            for field in self.fields
        }

    def _record(self, number: int, values: Mapping[str, Any]) -> dict[str, Any]:
        episode, instance = divmod(number, self.instance_nb)
        return {"set": number, "env_id": instance + 1, "episode": episode, **values}
