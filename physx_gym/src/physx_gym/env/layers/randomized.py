"""The layer of domain randomization."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from physx_core.errors import ConfigError
from physx_core.plugins import import_component
from physx_gym.env.layers.layer import Layer
from physx_gym.env.pipeline_env import PipelineEnv
from physx_gym.tasks.randomizations import Randomization
from physx_gym.tasks.randomizations.randomization import Nominal

_POSTERIOR = "physx_identify:Identified"
"""Draws from a file; of a package that builds on this one, so it is named, not imported."""


class RandomizedEnv(Layer):
    """Draws properties of the world from ranges, anew for each episode.

    The draws depend only on the environment's seed and the number of the episode: initial states,
    noise and all other randomness stay as they are without this layer. Factors apply to the values
    that the environment had when this layer was put on it. New delays and noise require a new
    simulation, which takes some milliseconds; masses, friction, gains and pushes do not.

    Attributes:
        randomizations: What is drawn.
        every: Number of episodes between two draws.
        drawn: Values drawn for the present episode, by the randomizations' names; also in the
            constants of the log, as ``"randomization"``.
    """

    constants: ClassVar[tuple[str, ...]] = (
        "randomizations",
        "every",
        "drawn",
        "_prepared",
        "_nominal_options",
    )

    def __init__(
        self,
        env: PipelineEnv,
        *,
        randomizations: Sequence[Randomization | str | Path] | Randomization | str | Path,
        every: int = 1,
    ) -> None:
        """Add randomizations to an environment.

        Args:
            env: The environment.
            randomizations: One or more, with different names. A file of ``physx identify -o``
                stands for draws from its posterior.
            every: Number of episodes that share the drawn values.

        Raises:
            ConfigError: If one is not a `Randomization`, two have the same name, the environment is
                randomized already, or lacks what is randomized.
            ComponentNotFoundError: If a randomization names something that is not there, or a file
                is given and the package physx-identify is not installed.
        """
        if isinstance(randomizations, (Randomization, str, Path)):
            randomizations = [randomizations]
        self.randomizations = tuple(map(_randomization, randomizations))
        self.every = every
        self.drawn: dict[str, Any] = {}
        self._prepared: dict[str, Any] | None = None
        super().__init__(env)
        self._check()
        self._nominal_options = env.simulator.get_options()
        self._draw_from(0, 0)  # to notice here what is missing

    def _check(self) -> None:
        if type(self.every) is not int or self.every < 1:
            raise ConfigError(
                f"RandomizedEnv.every is {self.every!r} but must be a number of episodes."
            )
        for each in self.randomizations:
            if not isinstance(each, Randomization):
                raise ConfigError(f"{each!r} is not a Randomization.")
        names = [each.name for each in self.randomizations]
        if len(set(names)) < len(names):
            raise ConfigError(f"Two randomizations have the same name: {sorted(names)}.")
        if any(isinstance(layer, RandomizedEnv) for layer in self.env.layers):
            raise ConfigError(
                "The pipeline already has a RandomizedEnv: pass all randomizations to one."
            )

    @property
    def _nominal(self) -> Nominal:
        return Nominal(self.env, self._nominal_options)

    def _draw(self, number: int) -> dict[str, Any]:
        """Draw the values for a group of `every` episodes, given its number."""
        seed = self.np_random_seed
        if seed < 0:  # the random generator was set, so the seed is not known
            seed = int(self.np_random.integers(2**32))
        return self._draw_from(seed, number)

    def _draw_from(self, seed: int, number: int) -> dict[str, Any]:
        found = {}
        for place, each in enumerate(self.randomizations):
            sequence = np.random.SeedSequence(seed, spawn_key=(3, place, number))
            found[each.name] = each.draw(self._nominal, np.random.default_rng(sequence))
        return found

    def _setup(self) -> None:
        super()._setup()
        before = self.drawn
        number, rest = divmod(self._base._control_loop.episode, self.every)
        if self._prepared:
            self.drawn = self._prepared
        elif rest == 0 or not before:
            self.drawn = self._draw(number)
        if self.drawn != before:
            options: dict[str, Any] = {}
            for each in self.randomizations:
                _merge(options, each.options(self._nominal, self.drawn[each.name]))
            self.simulator.set_options(options)
        for each in self.randomizations:
            each.apply(self.env, self.drawn[each.name])

    # State -----------------------------------------------------------------------------------

    def _memory(self) -> Any:
        return self.drawn

    def _recall(self, memory: Any) -> None:
        self._prepared = None

    def _prepare_restore(self, memory: Any) -> bool:
        self._prepared = memory
        return bool(memory != self.drawn)

    def _constants(self) -> dict[str, Any]:
        return {"randomization": self.drawn}


def _randomization(given: Any) -> Any:
    """Return a randomization; that of a posterior, if a file is given."""
    if not isinstance(given, (str, Path)) or Path(given).suffix != ".toml":
        return given
    return import_component("randomization", _POSTERIOR)(given)


def _merge(options: dict[str, Any], more: Mapping[str, Any]) -> None:
    """Add nested options to others; of the same option the last value stays."""
    for name, value in more.items():
        if isinstance(value, Mapping):
            _merge(options.setdefault(name, {}), value)
        else:
            options[name] = value
