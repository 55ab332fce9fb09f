"""Generator: has a gest-api generator choose the sets."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.components.parameter import Parameter
from physx_core.components.sampler import LearningSampler
from physx_core.errors import ConfigError, MissingLibraryError
from physx_core.plugins import import_component
from physx_core.typing import Array, Index

_LOSS = "loss"


class Generator(LearningSampler):
    """Has a gest-api generator choose the sets, such as those of libEnsemble and Xopt.

    The generator gets the parameters' bounds as variables, one for each element (``name_0``,
    ``name_1`` ... if a parameter has a shape), and the objective ``loss``. It suggests `points`
    sets at once; when it has ingested the sets of a batch with their mean losses, it suggests new
    ones. Runs are reproducible if the generator suggests the same after the same losses: give it a
    seed. They cannot be resumed while environments generate.
    """

    def __init__(
        self,
        generator: str | Callable[..., Any],
        generator_kwargs: Mapping[str, Any] | None = None,
        objective: str = "MAXIMIZE",
        points: int = 32,
        memory: int = 512,
    ) -> None:
        """Store the options.

        Args:
            generator: The generator's class, or ``"package.module:Class"``.
            generator_kwargs: Arguments of its constructor other than variables and objectives.
            objective: What it does with the loss: ``"MAXIMIZE"`` or ``"EXPLORE"``.
            points: Number of sets that it suggests at once.
            memory: Number of most recent sets whose losses it ingests.

        Raises:
            ConfigError: If an option is out of range.
        """
        for name, number in (("points", points), ("memory", memory)):
            if type(number) is not int or number < 1:
                raise ConfigError(f'"physx/generator": {name} is {number!r}, not at least 1.')
        self._make, self._arguments = generator, dict(generator_kwargs or {})
        self._objective, self._points = objective, points
        self.memory = memory

    def begin(self, parameters: Sequence[Parameter], seed: Sequence[int]) -> None:
        """Create the generator: see `Sampler.begin`."""
        super().begin(parameters, seed)
        try:
            from gest_api.vocs import VOCS
        except ImportError as error:
            raise MissingLibraryError('"physx/generator"', "gest-api", "samplers") from error
        domains: dict[str, list[float]] = {}
        for parameter in parameters:
            if not parameter.is_bounded:
                raise ConfigError(
                    f'"physx/generator" needs bounds: the parameter "{parameter.name}" has none.'
                )
            bounds = zip(parameter.columns, parameter.low, parameter.high, strict=True)
            domains |= {name: [low, high] for name, low, high in bounds}
        make = self._make
        if isinstance(make, str):
            make = import_component("generator", make)
        self._generator = make(
            VOCS(variables=domains, objectives={_LOSS: self._objective}), **self._arguments
        )
        self._ids: dict[int, Any] = {}
        self._suggested = self._suggest()

    def ask(self, number: int) -> dict[str, Any]:
        """Return the values of a set: see `LearningSampler.ask`."""
        if not self._suggested:
            self._suggested = self._suggest()
        point = self._suggested.popleft()
        if "_id" in point:
            self._ids[number] = point["_id"]
        values = {}
        for parameter in self.parameters:
            flat = np.array([point[name] for name in parameter.columns])
            is_whole = parameter.distribution == "integer"
            flat = np.rint(flat).astype(np.int64) if is_whole else flat.astype(np.float64)
            values[parameter.name] = flat.reshape(parameter.shape)
        return values

    def tell(self, numbers: Index, values: Sequence[Mapping[str, Any]], losses: Array) -> None:
        """Make the generator learn from a batch: see `LearningSampler.tell`."""
        results = []
        for number, given, loss in zip(numbers.tolist(), values, losses.tolist(), strict=True):
            result: dict[str, Any] = {_LOSS: loss}
            for parameter in self.parameters:
                flat = np.ravel(given[parameter.name]).tolist()
                result |= zip(parameter.columns, flat, strict=True)
            if number in self._ids:
                result["_id"] = self._ids[number]
            results.append(result)
        if results:
            for number in [known for known in self._ids if known <= numbers[-1] - self.memory]:
                del self._ids[number]
            self._generator.ingest(results)
        self._suggested.clear()

    def state(self) -> Array:
        """Return nothing: the generator keeps its own state."""
        return np.zeros(0)

    def restore(self, state: Array) -> None:
        """Refuse to continue: see `LearningSampler.restore`."""
        raise ValueError('"physx/generator" cannot be resumed')

    def _suggest(self) -> deque[dict[str, Any]]:
        points: list[dict[str, Any]] = self._generator.suggest(self._points)
        if len(points) != self._points:
            raise ConfigError(
                f"{type(self._generator).__name__}.suggest({self._points}) returned {len(points)} "
                'points: choose a number of "points" that it can suggest.'
            )
        return deque(points)
