"""Finds the checkpoint, dataset, and environments that a training resumes from."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from physx_core import checkpoint
from physx_core.checkpoint import Checkpoint
from physx_core.config import SETS, WRONG, EnvironmentConfig
from physx_core.dataset import Dataset
from physx_core.dataset.store.manifest import to_plain_info
from physx_core.errors import ConfigError, DatasetNotFoundError
from physx_core.pipelines.storage import (
    GENERATION,
    is_copy,
    keep_parameters,
    restore_parameters,
)
from physx_core.session import Session
from physx_core.views.dataset_config import DatasetConfig
from physx_core.workers.instance import NOTHING, Skip

_SAME = (
    "environment",
    "env_kwargs",
    "num_clients",
    "independent_episodes",
    "episode_steps",
    "simulations_per_step",
    "sampler",
    "sampler_kwargs",
    "seed",
)


@dataclass(frozen=True)
class Generation:
    """Everything that determines the rows that a training's environments generate.

    It is stored in the dataset so that a killed run can be resumed: its environments generate the
    same rows again.

    Attributes:
        mode: Mode in which the rows are stored.
        first: Number of rows that the mode had before.
        first_wrong: Number of rejected samples that existed before.
        first_set: Number of sets of parameters that existed before.
        offset: Number of rows of the mode "training" before; the seed is derived from it.
        seed: Seed of the training.
        batch_size: Number of rows in a batch.
        batch_nb: Number of batches in an epoch.
        environment: Description of the environment: see `describe_environment`.
        depends: Whether the rows depend on the learning network through its predictions for an
            environment; if so, they cannot be generated again.
        campaign: Number of the campaign in the mode; None: the rows are those of streams.
        ended: Numbers of rows, rejected samples, and sets that the mode and the whole dataset had
            when another run started to add its own; None: there is none. See `end_generation`.
    """

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
        dataset: Dataset,
        mode: str,
        seed: int,
        batch_size: int,
        batch_nb: int | None,
        environment: Mapping[str, Any],
    ) -> Self:
        """Return the description of a training that starts now."""
        counted = (mode, WRONG, SETS, "training")
        first, wrong, sets, offset = (dataset.num_samples(name) for name in counted)
        described = to_plain_info({name: environment.get(name) for name in _SAME})
        return cls(mode, first, wrong, sets, offset, seed, batch_size, batch_nb, described)

    def start(self, dataset: Dataset) -> None:
        """Store it in the dataset, and back up the parameters that environments saved there."""
        keep_parameters(dataset.directory)
        self.store(dataset)

    def store(self, dataset: Dataset) -> None:
        """Store it in the dataset."""
        dataset.update_info(**{GENERATION: dataclasses.asdict(self)})

    def resume(
        self, dataset: Dataset, environment: EnvironmentConfig, now: Generation, needed: int
    ) -> Skip:
        """Check that a training continues this one, and return the rows that it has already had.

        The parameters that environments saved are restored to those at its start.

        Args:
            dataset: Contains the rows.
            environment: The environment.
            now: The description that the training would have if it started now.
            needed: Total number of rows that the training needs.
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
                    f"The training cannot be resumed while environments generate its samples: "
                    f"{name} was {before[name]!r} and is now {value!r}, so the samples would "
                    "differ. Use the same value, or start another training."
                )
        ends = now.first, now.first_wrong, now.first_set
        if self.ended is not None and tuple(self.ended) != ends:
            ends = (self.ended[0], self.ended[1], self.ended[2])
            if ends[0] - self.first < needed:
                raise ConfigError(
                    f"The training cannot be resumed while environments generate its samples: "
                    f"{ends[0] - self.first} of {needed} exist, and other runs have added theirs, "
                    f"so no more can follow. {_advice(dataset.directory.parent)}"
                )
        restore_parameters(dataset.directory)
        if self.campaign is not None:
            return NOTHING
        rejected: tuple[int, ...] = ()
        if ends[1] > self.first_wrong:
            numbers = dataset[WRONG]["env_id"][self.first_wrong : ends[1]]
            found = np.bincount(numbers, minlength=environment.num_clients + 1)
            rejected = tuple(int(count) for count in found[1:])
        rows = ends[0] - self.first
        begun, sets = {}, ends[2] - self.first_set
        if rows and sets:
            view = dataset[self.mode]
            begun = {name: view[name][self.first : ends[0]] for name in ("env_id", "episode")}
        return Skip(rows, rejected, sets, begun)


@dataclass(frozen=True)
class Start:
    """Where a training starts.

    Attributes:
        config: Options of its dataset.
        environment: Generates or replays samples; None: samples are only read from now on.
        session: The session that it continues; None: it gets a new one.
        checkpoint: What it resumes from; None: it starts with its first batch.
        generation: Description of the samples that environments have generated; None if there are
            none.
    """

    config: DatasetConfig
    environment: EnvironmentConfig | None
    session: Session | None = None
    checkpoint: Checkpoint | None = None
    generation: Generation | None = None

    @property
    def generates(self) -> bool:
        """Whether environments generate samples."""
        return self.environment is not None and not self.environment.load_samples


def find_start(
    session: Session, name: str, environment: EnvironmentConfig | None, config: DatasetConfig
) -> Start:
    """Return where a training resumes.

    Args:
        session: The training's session.
        name: Name of the network.
        environment: The environment of the samples.
        config: Options of the dataset.
    """
    info: Mapping[str, Any] = {}
    is_empty = True
    config = _without_copied_dataset(session, config)
    if environment is not None and not environment.load_samples:
        with contextlib.suppress(DatasetNotFoundError), Dataset.open(session.dataset_dir) as data:
            info, is_empty = data.info, not any(data.num_samples(mode) for mode in data.modes)
        generation = _parse(info.get(GENERATION))
        is_new = not checkpoint.list_numbers(session.network_dir, name)
        if is_new and (generation is not None or is_empty):
            _check_repeatable(generation, session)
            return Start(config, environment, session, None, generation)
    found = checkpoint.find(session.network_dir, name, -1)
    if can_resume(environment, found.progress.epoch):
        return Start(config, None, session, found)
    generation = _parse(info.get(GENERATION))
    if generation is None:
        raise ConfigError(
            "A training cannot be resumed while environments generate its samples, because they "
            f"would start over. {_advice(session.path)}"
        )
    _check_repeatable(generation, session)
    return Start(config, environment, session, found, generation)


def _check_repeatable(generation: Generation | None, session: Session) -> None:
    if generation is not None and generation.depends:
        raise ConfigError(
            "A training cannot be resumed while environments generate its samples if the samples "
            "depend on the learning network's predictions (get_prediction), as they do here: they "
            f"cannot be generated again. {_advice(session.path)}"
        )


def _advice(session: Path) -> str:
    return (
        "Leave out the environment to train on the stored samples, or start another training from "
        f"its network: NetworkConfig.network_dir={str(session)!r} (--network.network-dir "
        f"{session})."
    )


def _parse(plain: Any) -> Generation | None:
    """Return the description in a dataset's info; None if it is missing or invalid."""
    try:
        return Generation(**plain)
    except TypeError:
        return None


def can_resume(environment: EnvironmentConfig | None, epochs: int) -> bool:
    """Return whether a training that has finished some epochs no longer needs environments."""
    if environment is None:
        return True
    replays = environment.load_samples and not environment.only_first_epoch
    return epochs > 0 and not replays and not environment.always_produce


def _without_copied_dataset(session: Session, config: DatasetConfig) -> DatasetConfig:
    """Return the configuration, without the existing dataset if the session has a copy of it."""
    if config.existing_dir is None or not is_copy(session.dataset_dir):
        return config
    return dataclasses.replace(config, existing_dir=None)
