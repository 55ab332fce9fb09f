"""ParameterSets: the sets of parameters that a source's environments get."""

from __future__ import annotations

import contextlib
import inspect
import threading
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.components.environment import options_of
from physx_core.components.parameter import SET_FIELDS, Parameter
from physx_core.components.sampler import LearningSampler, Sampler, checked, checked_many
from physx_core.config import MODES, EnvironmentConfig
from physx_core.errors import (
    ClientError,
    ConfigError,
    EnvironmentFailedError,
    FieldsMismatchError,
    NotFiniteError,
    PhysxError,
    ProgramError,
    UnknownOptionError,
    UsageError,
    WrongSamplesError,
)
from physx_core.fields import Field
from physx_core.plugins import resolve
from physx_core.typing import Array, Batch, Index
from physx_core.workers.instance import NOTHING, Skip

_DEFAULT = "physx/uniform"
_OF_PARAMETERS = (
    EnvironmentFailedError,
    ClientError,
    ProgramError,
    NotFiniteError,
    WrongSamplesError,
)
"""Failures of a simulation that its parameters may have caused."""


class ParameterSets:
    """Gets sets from a sampler, and keeps them until the rows of their episodes are stored.

    Set k is for episode ``k // instance_nb`` of instance ``k % instance_nb + 1``.

    Attributes:
        instance_nb: Number of instances.
        parameters: The parameters that the environment defines.
        failures: Set number to description, for each set whose simulation failed.
        count: Number of sets found so far.
    """

    def __init__(
        self, config: EnvironmentConfig, seed: Sequence[int], skip: Skip = NOTHING
    ) -> None:
        """Create the configured sampler.

        Args:
            config: Names the sampler, the number of instances, and how many sets may fail.
            seed: Seed of the run.
            skip: What an earlier run already got, including the record of its sets.
        """
        if config.redraw and config.load_samples:
            raise ConfigError(
                "EnvironmentConfig.redraw draws new parameters, but load_samples replays stored "
                "samples: leave redraw out."
            )
        if config.sampler is None and config.sampler_kwargs:
            raise ConfigError("EnvironmentConfig.sampler_kwargs is given without a sampler.")
        self.parameters: list[Parameter] = []
        self.failures: dict[int, str] = {}
        self.count = 0
        self._config, self._seed = config, list(seed)
        self.instance_nb = config.num_clients
        self._skip = skip
        self._recorded = {number: row for row, number in enumerate(skip.sets.get("set", ()))}
        self._surplus = len(self._recorded)  # sets that are already recorded
        self._sampler = None if config.sampler is None else _make_sampler(config, config.sampler)
        self._redraws = [0] * self.instance_nb
        self._waiting: list[dict[int, Mapping[str, Any]]] = [{} for _ in self._redraws]
        self._stored: dict[int, int] = {}  # number of an instance's current set to its index
        self._begun: list[dict[str, Any]] = []
        self._needed: Callable[[int], int] | None = None
        self._values: dict[int, Mapping[str, Any]] = {}  # of the sets whose losses may yet arrive
        self._told, self._newest = 0, -1
        self._changed = threading.Condition()
        self._is_canceled = False
        self._failed: list[int] = []

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
        if not first and (self._config.sampler is not None or self._config.redraw):
            option = "sampler" if self._config.sampler is not None else "redraw"
            raise ConfigError(
                f"EnvironmentConfig.{option} is set, but the environment defines no parameters: "
                "call define_parameters() in its create() and implement reset_parameters(), or "
                f"leave {option} out."
            )
        if first:
            self._sampler = self._sampler or _make_sampler(self._config, _DEFAULT)
            self._sampler.begin(first, self._seed)
        if self.learns:
            self._values = {int(number): self._read(row) for number, row in self._recorded.items()}

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

    @property
    def learns(self) -> bool:
        """Whether the sampler learns from training losses."""
        return isinstance(self._sampler, LearningSampler) and bool(self.parameters)

    def _read(self, row: int) -> dict[str, Any]:
        """Return the values of a set that an earlier run recorded."""
        record = self._skip.sets
        return checked(self.parameters, {p.name: record[p.name][row] for p in self.parameters})

    def state(self, batches: int) -> Array | None:
        """Return what `restore` needs after some batches; None if the sampler does not learn.

        Args:
            batches: Number of batches: all that the sampler was told of, or all but the last one.
        """
        if not isinstance(self._sampler, LearningSampler) or not self.parameters:
            return None
        with self._changed:
            return np.concatenate([[self._newest], self._sampler.state(batches)])

    def restore(self, batches: int, state: Array) -> None:
        """Make the sampler continue after some batches, before anything is chosen.

        Raises:
            ValueError: If `state` is not a state of this sampler.
        """
        assert isinstance(self._sampler, LearningSampler)
        if not len(state):
            raise ValueError("it is empty")
        self._sampler.restore(batches, state[1:])
        self._told, self._newest = batches, int(state[0])

    def follow(self, needed: Callable[[int], int]) -> None:
        """Make the sampler learn from a training run.

        Args:
            needed: Returns how many rows must have arrived before a batch; never decreases.
        """
        self._needed = needed

    def tell(self, numbers: Index, losses: Array) -> None:
        """Make the sampler learn from the next training batch.

        Args:
            numbers: Numbers of the sets of the batch's rows.
            losses: Losses of these rows.
        """
        sampler = self._sampler
        assert isinstance(sampler, LearningSampler)
        found, places = np.unique(numbers, return_inverse=True)
        means = np.bincount(places, losses) / np.bincount(places)
        with self._changed:
            self._newest = max(self._newest, int(found[-1]))
            oldest = self._newest - sampler.memory
            for number in [known for known in self._values if known <= oldest]:
                del self._values[number]
            kept = [place for place, number in enumerate(found.tolist()) if number in self._values]
            values = [self._values[int(found[place])] for place in kept]
            self._told += 1
            sampler.tell(self._told, found[kept], values, means[kept])
            self._changed.notify_all()

    def cancel(self) -> None:
        """End a call to `choose` that waits for losses soon, with an error."""
        with self._changed:
            self._is_canceled = True
            self._changed.notify_all()

    def is_ready(self, row: int) -> bool:
        """Return whether the losses that a row's set depends on are known."""
        return not self.learns or self._told >= self._batches_for(row)

    def _batches_for(self, row: int) -> int:
        """Return how many batches a set requested for a row may depend on."""
        sampler, needed = self._sampler, self._needed
        assert isinstance(sampler, LearningSampler)
        if needed is None:
            raise UsageError(
                f"The sampler {type(sampler).__name__} learns from training losses on generated "
                'samples, but nothing is trained here. Use "physx/sobol".'
            )
        end = 1
        while needed(end - 1) <= row:
            end *= 2
        batch = bisect_right(range(end), row, key=needed)
        return max(0, batch - sampler.delay)

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
        with self._naming(f"{numbers[0]} and later ones" if len(numbers) > 1 else numbers[0]):
            values = self._sampler.ask_many(numbers[0], len(numbers))
            return checked_many(self.parameters, values, len(numbers))

    def choose(self, instance_id: int, episode: int, row: int) -> dict[str, Any]:
        """Return the values of the parameters for an episode of an instance.

        If they depend on losses that are not known yet, this waits for them, in a thread other
        than the training's.

        Args:
            instance_id: The instance.
            episode: The episode.
            row: Index, among all rows, of the one that the instance is generating.

        Raises:
            ConfigError: If the sampler fails, or what it chooses does not fit the parameters.
            UsageError: If the sampler learns, but nothing is trained.
        """
        if not self.parameters:
            raise UsageError("Parameters can be chosen only once all instances have defined them.")
        number = self._number(instance_id, episode)
        values = self._ask(number, row)
        self._waiting[instance_id - 1][number] = values
        return dict(values)

    def _ask(self, number: int, row: int) -> dict[str, Any]:
        sampler = self._sampler
        assert sampler is not None
        with self._naming(number):
            if not isinstance(sampler, LearningSampler):
                return checked(self.parameters, sampler.ask(number))
            if number in self._recorded:
                return self._read(self._recorded[number])
            batches = self._batches_for(row)
            with self._changed:
                self._changed.wait_for(lambda: self._is_canceled or self._told >= batches)
                if self._is_canceled:
                    raise UsageError("The training is being closed.")
                values = checked(self.parameters, sampler.ask_after(number, batches))
                self._values[number] = values
                return values

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

    def can_redraw(self, instance_id: int, error: PhysxError) -> bool:
        """Return whether an instance may continue with its next set after a failure."""
        return (
            isinstance(error, _OF_PARAMETERS)
            and bool(self._waiting[instance_id - 1])
            and self._redraws[instance_id - 1] < self._config.redraw
        )

    def redraw(self, instance_id: int, episode: int, error: PhysxError) -> str:
        """Record that an episode's simulation failed, and that the next set takes its place.

        Returns:
            A description for the log.
        """
        self._redraws[instance_id - 1] += 1
        self.fail(instance_id, episode, error)
        number = self._number(instance_id, episode)
        return (
            f"The parameters were set {number} ({self._describe(number)}). The instance continues "
            f"with its next set. Redraw {self._redraws[instance_id - 1]} of {self._config.redraw}."
        )

    def fail(self, instance_id: int, episode: int, error: PhysxError) -> None:
        """Record that an episode's simulation failed, if its parameters may be the cause."""
        number = self._number(instance_id, episode)
        if isinstance(error, _OF_PARAMETERS) and number in self._waiting[instance_id - 1]:
            self.failures[number] = f"{self._describe(number)}: {str(error).partition(chr(10))[0]}"

    def _number(self, instance_id: int, episode: int) -> int:
        return episode * self.instance_nb + instance_id - 1

    def _describe(self, number: int) -> str:
        values = self._waiting[number % self.instance_nb][number]
        return ", ".join(f"{name}={value}" for name, value in values.items())

    def note(self, batch: Batch) -> None:
        """Find the sets that begin in a batch of rows, in the order of their first rows.

        A set that failed before its first row precedes its instance's next one.
        """
        self._begun, self._failed = [], []
        if not self.parameters:
            return
        skip = self._skip
        rows = {name: batch[name] for name in ("episode", "env_id")}
        if skip.begun:
            self._skip = skip._replace(begun={})
            rows = {name: np.concatenate([skip.begun[name], rows[name]]) for name in rows}
        numbers = np.asarray(rows["episode"], np.int64) * self.instance_nb + rows["env_id"] - 1
        found, first = np.unique(numbers, return_index=True)
        for number in found[np.argsort(first)].tolist():
            waiting = self._waiting[number % self.instance_nb]
            for earlier in [known for known in waiting if known < number]:
                self._settle(earlier, waiting)
            if number in waiting and number not in self._stored:
                self._stored[number] = self.count
                self._add(number, waiting[number], failed=False)
        recorded = min(self._surplus, len(self._begun))
        self._surplus -= recorded
        del self._begun[:recorded]

    def note_failed(self) -> None:
        """At the end of a run, find the failed sets that no later row follows."""
        self._begun, self._failed = [], []
        for waiting in self._waiting:
            for number in [known for known in waiting if known in self.failures]:
                self._settle(number, waiting)

    def pop(self, mode: str) -> tuple[Batch, list[int]]:
        """Return and clear the sets that were found last.

        Args:
            mode: Mode of the rows.

        Returns:
            The record of the sets that begin, field name to array; and the indices, in the record
            of the whole run, of earlier sets that failed.
        """
        begun, failed = self._begun, self._failed
        self._begun, self._failed = [], []
        if not begun:
            return {}, failed
        begun = [{**one, "mode_index": MODES.index(mode)} for one in begun]
        columns = {
            field.name: np.array([one[field.name] for one in begun], field.numpy_dtype)
            for field in self.fields
        }
        return columns, failed

    def _settle(self, number: int, waiting: dict[int, Mapping[str, Any]]) -> None:
        """Account for a set that gets no more rows."""
        values = waiting.pop(number)
        place = self._stored.pop(number, None)
        has_failed = number in self.failures
        if place is None:
            self._add(number, values, failed=has_failed)
        elif has_failed:
            self._failed.append(place)

    def _add(self, number: int, values: Mapping[str, Any], *, failed: bool) -> None:
        episode, instance = divmod(number, self.instance_nb)
        identity = {"set": number, "env_id": instance + 1, "episode": episode, "failed": failed}
        self._begun.append({**identity, **values})
        self.count += 1


def next_step(last_step: int, error: PhysxError) -> int:
    """Return the number of the first step after a failed simulation.

    Args:
        last_step: Step of its last row, -1 if it has none.
        error: Its error.
    """
    return max(last_step, getattr(error, "step", -1)) + 1


def _make_sampler(config: EnvironmentConfig, reference: str | type[Any]) -> Sampler:
    make = resolve("sampler", reference)
    name = reference if isinstance(reference, str) else getattr(make, "__name__", repr(make))
    if inspect.isabstract(make):
        raise ConfigError(f"The sampler {name} is not complete: it does not implement ask().")
    try:
        sampler = make(**config.sampler_kwargs)
    except TypeError as error:
        known = options_of(make) if isinstance(make, type) else list(config.sampler_kwargs)
        unknown = config.sampler_kwargs.keys() - set(known)
        if unknown:
            raise UnknownOptionError(f'The sampler "{name}"', unknown, known) from error
        raise ConfigError(f'The sampler "{name}" rejects its arguments: {error}.') from error
    if not isinstance(sampler, Sampler):
        raise ConfigError(f"EnvironmentConfig.sampler: {name} is not a Sampler.")
    return sampler
