"""Sampler: base class for choosing the parameters of the next simulations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from physx_core.components.parameter import Parameter, Point, random_of, values_at
from physx_core.errors import ConfigError
from physx_core.fields import Field, is_finite
from physx_core.typing import Array, Batch, Index


class Sampler(ABC):
    """Chooses sets of parameters; plugins offer their own with the hook ``physx_samplers``.

    The constructor takes the entries of `EnvironmentConfig.sampler_kwargs`; `begin` follows. Sets
    are numbered from 0: set k is for episode k if episodes are independent, and for trajectory
    ``k // instance_nb`` of instance ``k % instance_nb`` (from 0 here) of streams. Sets are
    requested in any order, and again when a run is resumed, so what `ask` returns may depend only
    on the arguments of `begin` and on the set's number, except for a `LearningSampler`.

    Attributes:
        parameters: The parameters to choose.
        seed: Seed of the run.
        size: Number of elements of all parameters.
    """

    parameters: Sequence[Parameter]
    seed: Sequence[int]
    size: int

    def begin(self, parameters: Sequence[Parameter], seed: Sequence[int]) -> None:
        """Take the parameters that the environment defines.

        Args:
            parameters: The parameters.
            seed: Seed of the run.

        Raises:
            ConfigError: If the sampler cannot choose them.
        """
        self.parameters, self.seed = list(parameters), list(seed)
        self.size = sum(parameter.size for parameter in parameters)

    @abstractmethod
    def ask(self, number: int) -> Mapping[str, Any]:
        """Return the values of a set by the parameters' names.

        Args:
            number: Number of the set, from 0.
        """

    def ask_many(self, first: int, count: int) -> Mapping[str, Any]:
        """Return the values of consecutive sets, the same as of `ask`, by the parameters' names.

        Override it if that is faster than one by one.

        Args:
            first: Number of the first set.
            count: Number of sets, at least 1; shape of each array: (count, *parameter's shape).
        """
        sets = [checked(self.parameters, self.ask(first + place)) for place in range(count)]
        return {p.name: np.array([one[p.name] for one in sets]) for p in self.parameters}

    def values(self, point: Point) -> dict[str, Any]:
        """Return the parameters' values at a point of the unit cube, or at several.

        A uniformly distributed point yields values from the parameters' distributions.

        Args:
            point: Shape (size,), each from 0 to 1; (n, size) for arrays of n values.
        """
        return values_at(self.parameters, point)

    def random(self, number: int) -> np.random.Generator:
        """Return a random generator determined only by the seed and the number of a set."""
        return random_of(self.seed, number, 1)


class LearningSampler(Sampler):
    """A sampler that learns from the losses of training rows of independent episodes.

    It is asked for each set once, in order of the numbers, and told the losses of each batch once,
    in order of the batches. What it has been told before a set is counted in episodes, never in
    time: see `Training.run_ahead`. So the simulations are the same in every run.

    Attributes:
        memory: Number of sets, up to the latest one with losses, that the sampler is told of.
    """

    memory: int = 512

    @abstractmethod
    def ask(self, number: int) -> Mapping[str, Any]:
        """Return the values of a set, which may depend on the losses told so far: see `Sampler`."""

    @abstractmethod
    def tell(self, numbers: Index, values: Sequence[Mapping[str, Any]], losses: Array) -> None:
        """Learn from a batch.

        Args:
            numbers: Numbers of the sets with rows in the batch, increasing.
            values: Their values.
            losses: Mean loss of the batch's rows of each set.
        """

    @abstractmethod
    def state(self) -> Array:
        """Return what `restore` needs to continue, as numbers, shape (n,)."""

    @abstractmethod
    def restore(self, state: Array) -> None:
        """Continue from a `state` of a sampler with the same options; called after `begin`.

        Raises:
            ValueError: If `state` is not the state of such a sampler.
        """


def checked_many(parameters: Sequence[Parameter], values: Mapping[str, Any], count: int) -> Batch:
    """Return the values that a sampler chose for several sets, as `checked` does for one.

    Args:
        parameters: The parameters.
        values: Name to an array of shape (count, *parameter's shape).
        count: Number of sets.

    Raises:
        ConfigError: If a value is missing, unknown, not finite, or of another shape or type.
    """
    stacked = {p.name: replace(p.field, shape=(count, *p.shape)) for p in parameters}
    return _fitting(stacked, values)


def checked(parameters: Sequence[Parameter], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that a sampler chose, after checking that they fit the parameters.

    Raises:
        ConfigError: If a value is missing, unknown, not finite, or of another shape or type.
    """
    fitting = _fitting({parameter.name: parameter.field for parameter in parameters}, values)
    return {name: array if array.ndim else array.item() for name, array in fitting.items()}


def _fitting(fields: Mapping[str, Field], values: Mapping[str, Any]) -> Batch:
    """Return values as arrays of their fields' types."""
    if not isinstance(values, Mapping) or set(values) != set(fields):
        given = list(values) if isinstance(values, Mapping) else values
        raise ConfigError(f"The sampler chose {given}, but the parameters are {list(fields)}.")
    fitting: Batch = {}
    for name, field in fields.items():
        try:
            array: Array = field.convert(values[name])
        except Exception as error:
            raise ConfigError(f"The sampler's choice does not fit: {error}") from error
        if not is_finite(array):
            raise ConfigError(f'The sampler chose "{name}" = {array}: not finite.')
        fitting[name] = array
    return fitting
