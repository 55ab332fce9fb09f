"""Plan: the trials of a study, batch by batch."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from physx_cluster.sweep.definition import Definition
from physx_cluster.sweep.optuna import PREFIX, OptunaSearch, known_samplers
from physx_cluster.sweep.parameters import MOST, Parameter, Setting, count_grid, grid_of
from physx_cluster.sweep.results import Result, Trial
from physx_core.errors import ConfigError, listed, nearest


class Search(Protocol):
    """Chooses the settings of one pipeline."""

    def ask(self, count: int) -> list[Setting]:
        """Return the next settings, fewer than requested if there are no more."""

    def tell(self, results: Sequence[Sequence[Result]]) -> None:
        """Take the results of the last requested settings, one for each seed."""


class Plan:
    """The trials of a study, in an order that depends only on its definition and results.

    Within a batch, trials are numbered by setting, then pipeline, then seed. More settings
    therefore leave the numbers of the first ones unchanged.

    Attributes:
        total: Number of trials.
        together: Largest number of trials in a batch.
    """

    def __init__(self, definition: Definition) -> None:
        """Start before the first batch.

        Raises:
            ConfigError: If there are too many trials, or the sampler cannot choose settings of
                these parameters.
        """
        study = definition.study
        self._seeds = study.seeds
        self._left = _count_settings(definition)
        self._searches = {
            name: Grid(grid_of(pipeline.parameters))
            if study.sampler == "grid"
            else _search(definition, pipeline.parameters)
            for name, pipeline in definition.pipelines.items()
        }
        waits = study.sampler.startswith(PREFIX) or study.pruner is not None
        self._batch = study.batch if waits else max(self._left.values())
        self.total = sum(self._left.values()) * len(self._seeds)
        self.together = min(self.total, self._batch * len(self._left) * len(self._seeds))
        self._settings, self._trials = 0, 0
        self._last: list[Trial] = []

    def next_batch(self) -> list[Trial]:
        """Return the next trials; empty at the end. First call `tell` with the last results."""
        chosen = {}
        for name, search in self._searches.items():
            count = min(self._batch, self._left[name])
            self._left[name] -= count
            chosen[name] = search.ask(count)
        known, self._last = self._trials, []
        for place in range(max(map(len, chosen.values()))):
            for name, settings in chosen.items():
                for seed in self._seeds if place < len(settings) else ():
                    self._trials += 1
                    setting = self._settings + place + 1
                    values = settings[place]
                    self._last.append(Trial(self._trials, name, setting, seed, values, known))
        self._settings += self._batch
        return self._last

    def tell(self, results: Mapping[int, Result]) -> None:
        """Take the results of all trials of the last batch, by trial number."""
        for name, search in self._searches.items():
            of_pipeline = [trial for trial in self._last if trial.pipeline == name]
            groups = itertools.groupby(of_pipeline, lambda trial: trial.setting)
            search.tell([[results[trial.number] for trial in trials] for _, trials in groups])


class Grid:
    """Chooses all combinations in order."""

    def __init__(self, settings: list[Setting]) -> None:
        """Start with the first combination."""
        self._next = iter(settings)

    def ask(self, count: int) -> list[Setting]:
        """Return the next combinations."""
        return list(itertools.islice(self._next, count))

    def tell(self, results: Sequence[Sequence[Result]]) -> None:
        """Do nothing: a grid does not depend on results."""


class RandomSearch:
    """Chooses settings at random; each depends only on the seed and its own number."""

    def __init__(self, parameters: Mapping[str, Parameter], seed: int) -> None:
        """Start with the first setting."""
        self._parameters, self._seed, self._number = parameters, seed, 0

    def ask(self, count: int) -> list[Setting]:
        """Return the next settings."""
        return [self._draw() for _ in range(count)]

    def tell(self, results: Sequence[Sequence[Result]]) -> None:
        """Do nothing: random choices do not depend on results."""

    def _draw(self) -> Setting:
        self._number += 1
        random = np.random.default_rng([self._seed, self._number])
        return {name: parameter.draw(random) for name, parameter in self._parameters.items()}


def _count_settings(definition: Definition) -> dict[str, int]:
    """Return the number of settings of each pipeline, before any is built.

    Raises:
        ConfigError: If there are more than `MOST` trials.
    """
    study = definition.study
    found = {
        name: count_grid(definition.name, pipeline.parameters)
        if study.sampler == "grid"
        else study.trials or 0
        for name, pipeline in definition.pipelines.items()
    }
    settings, seeds = sum(found.values()), len(study.seeds)
    if settings * seeds > MOST:
        advice = "Set a smaller number of study.trials"
        if study.sampler == "grid":
            advice = (
                'Draw some combinations with sampler = "random" and trials = 100, or list fewer'
            )
        raise ConfigError(
            f"{definition.name} has {settings * seeds} trials (settings: {settings}, seeds: "
            f"{seeds}), but a study can have at most {MOST}. {advice}"
            f"{', or use fewer seeds' if seeds > 1 else ''}."
        )
    return found


def _search(definition: Definition, parameters: Mapping[str, Parameter]) -> Search:
    study = definition.study
    if study.sampler == "random":
        return RandomSearch(parameters, study.seed)
    if study.sampler.startswith(PREFIX):
        return OptunaSearch(study.sampler, study.sampler_kwargs, parameters, study.seed, study.goal)
    known = ["grid", "random", *known_samplers()]
    guess = nearest(study.sampler, known) or nearest(PREFIX + study.sampler, known)
    raise ConfigError(f'There is no sampler "{study.sampler}".{guess} Available: {listed(known)}.')
