"""Generation: what the rows of streams depend on, stored with them so that a run can be resumed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from physx_core.config import MODES, SETS, WRONG, EnvironmentConfig
from physx_core.dataset import Dataset
from physx_core.dataset.store.manifest import to_plain_info
from physx_core.errors import ConfigError
from physx_core.pipelines.saved_parameters import (
    accept_parameters,
    keep_parameters,
    remove_unused_parameters,
    restore_parameters,
)
from physx_core.pipelines.storage import EPISODE_OPTIONS, GENERATIONS, end_generation
from physx_core.workers.pasts import NOTHING, Skip

_SAME = (*EPISODE_OPTIONS, "num_clients", "state_every", "seed")
"""Entries of a description on which the rows of streams depend."""


@dataclass(frozen=True)
class Generation:
    """Everything that determines the rows that a run's streams generate.

    It is stored in the dataset so that a killed run can be resumed: its environments go on from
    their states, or generate the same rows again.

    Attributes:
        entry: Entry of the dataset's info that holds it: `GENERATION` or `STREAMS`.
        mode: Mode in which the rows are stored.
        first: Number of rows that the mode had before.
        first_wrong: Number of rejected samples that existed before.
        first_set: Number of sets of parameters that existed before.
        offset: Number of rows of the mode "training" before; the seed is derived from it.
        seed: Seed of the training, or of the data generation.
        batch_size: Number of rows in a training's batch; 0: rows do not depend on batches.
        batch_nb: Number of batches in a training's epoch.
        environment: Description of the environment: see `describe_environment`.
        depends: Whether the rows depend on the learning network through its predictions for an
            environment; if so, they cannot be generated again.
        campaign: Number of the campaign in the mode; None: the rows are those of streams.
        ended: Numbers of rows, rejected samples, and sets that the mode and the whole dataset had
            when another run started to add its own; None: there is none. See `end_generation`.
    """

    entry: str
    mode: str
    first: int
    first_wrong: int
    first_set: int
    offset: int
    seed: int
    batch_size: int
    batch_nb: int | None
    environment: Mapping[str, Any]
    depends: bool = False
    campaign: int | None = None
    ended: Sequence[int] | None = None

    @classmethod
    def begin(
        cls,
        entry: str,
        dataset: Dataset,
        mode: str,
        seed: int,
        environment: Mapping[str, Any],
        batch_size: int = 0,
        batch_nb: int | None = None,
    ) -> Self:
        """Return the description of a run that starts now."""
        counted = (mode, WRONG, SETS, "training")
        first, wrong, sets, offset = (dataset.num_samples(name) for name in counted)
        described = to_plain_info({name: environment.get(name) for name in _SAME})
        return cls(entry, mode, first, wrong, sets, offset, seed, batch_size, batch_nb, described)

    @classmethod
    def find(cls, info: Mapping[str, Any], entry: str) -> Self | None:
        """Return the description in a dataset's info; None if it is missing or invalid."""
        try:
            return cls(**info[entry])
        except (KeyError, TypeError):
            return None

    @property
    def name(self) -> str:
        """What tells these streams from others in the dataset."""
        return f"{self.mode} {self.first} {self.seed}"

    def keep_parameters(self, dataset: Dataset) -> None:
        """Back up what instances have saved, with which these streams begin.

        What earlier streams saved that have no rows does not count.
        """
        remove_unused_parameters(dataset)
        for entry in GENERATIONS:
            last = self.find(dataset.info, entry)
            if last is None or last.ended is not None:
                continue
            if dataset.num_samples(last.mode) == last.first:
                last.restore_parameters(dataset)
        keep_parameters(dataset.directory, f"{self.entry} {self.name}")

    def start(self, dataset: Dataset) -> None:
        """Store it in the dataset, in place of the descriptions of other runs."""
        end_generation(dataset, *(entry for entry in GENERATIONS if entry != self.entry))
        self.store(dataset)
        accept_parameters(dataset.directory, self.entry)

    def restore_parameters(self, dataset: Dataset) -> None:
        """Restore what instances had saved when these streams began."""
        restore_parameters(dataset.directory, self.entry, f"{self.entry} {self.name}")

    def store(self, dataset: Dataset) -> None:
        """Store it in the dataset."""
        dataset.update_info(**{self.entry: dataclasses.asdict(self)})

    def resume(
        self,
        dataset: Dataset,
        environment: EnvironmentConfig,
        now: Generation,
        needed: int,
        advice: str,
    ) -> Skip:
        """Check that a run continues this one, and return what it has already had.

        Args:
            dataset: Contains the rows.
            environment: The environment.
            now: The description that the run would have if it started now.
            needed: Total number of rows that it needs.
            advice: What to do if it cannot go on, because others have added rows.

        Raises:
            ConfigError: If its rows would differ, or cannot follow.
        """
        before = {"batch_size": self.batch_size, "batch_nb": self.batch_nb, "mode": self.mode}
        after = {"batch_size": now.batch_size, "batch_nb": now.batch_nb, "mode": now.mode}
        before |= {name: self.environment.get(name) for name in _SAME}
        after |= {name: now.environment.get(name) for name in _SAME}
        if environment.seed is None:
            after["seed"] = before["seed"]
        if self.campaign is not None or now.first == self.first:  # else rows of streams exist
            after["num_clients"] = before["num_clients"]
        for name, value in after.items():
            if value != before[name]:
                raise ConfigError(
                    f"The run cannot be resumed while environments generate its samples: {name} "
                    f"was {before[name]!r} and is now {value!r}, so the samples would differ. Use "
                    "the same value, or start another run."
                )
        ends = now.first, now.first_wrong, now.first_set
        if self.ended is not None and tuple(self.ended) != ends:
            ends = (self.ended[0], self.ended[1], self.ended[2])
            if ends[0] - self.first < needed:
                raise ConfigError(
                    f"The run cannot be resumed while environments generate its samples: "
                    f"{ends[0] - self.first} of {needed} exist, and other runs have added theirs, "
                    f"so no more can follow. {advice}"
                )
        if self.campaign is not None:
            return NOTHING
        rejected: tuple[int, ...] = ()
        if ends[1] > self.first_wrong:
            numbers = dataset[WRONG]["env_id"][self.first_wrong : ends[1]]
            found = np.bincount(numbers, minlength=environment.num_clients + 1)
            rejected = tuple(int(count) for count in found[1:])
        sets: frozenset[int] = frozenset()
        if ends[2] > self.first_set:
            modes, numbers = (
                dataset[SETS][name][self.first_set : ends[2]] for name in ("mode_index", "set")
            )
            sets = frozenset(numbers[modes == MODES.index(self.mode)].tolist())
        return Skip(ends[0] - self.first, rejected, sets)
