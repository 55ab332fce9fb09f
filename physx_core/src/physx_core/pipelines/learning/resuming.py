"""Finds the checkpoint, dataset, and environments that a training resumes from."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physx_core import checkpoint
from physx_core.checkpoint import Checkpoint
from physx_core.config import EnvironmentConfig
from physx_core.dataset import Dataset
from physx_core.errors import ConfigError, DatasetNotFoundError
from physx_core.pipelines.generation import Generation
from physx_core.pipelines.storage import GENERATION, is_copy
from physx_core.session import Session
from physx_core.views.dataset_config import DatasetConfig


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
        generation = Generation.find(info, GENERATION)
        is_new = not checkpoint.list_numbers(session.network_dir, name)
        if is_new and (generation is not None or is_empty):
            return Start(config, environment, session, None, generation)
    found = checkpoint.find(session.network_dir, name, -1)
    if can_resume(environment, found.progress.epoch):
        return Start(config, None, session, found)
    generation = Generation.find(info, GENERATION)
    if generation is None:
        raise ConfigError(
            "A training cannot be resumed while environments generate its samples, because they "
            f"would start over. {advise(session.path)}"
        )
    if generation.depends and not checkpoint.has_streams(found):
        raise ConfigError(
            "A training cannot be resumed while environments generate its samples if the samples "
            "depend on the learning network's predictions (get_prediction), as they do here, and "
            f"the checkpoint {found.path.name} has no states from which the environments go on. "
            "Next time, set EnvironmentConfig.state_every (--environment.state-every). "
            f"{advise(session.path)}"
        )
    return Start(config, environment, session, found, generation)


def advise(session: Path) -> str:
    """Return what to do with a session whose training cannot be resumed."""
    return (
        "Leave out the environment to train on the stored samples, or start another training from "
        f"its network: NetworkConfig.network_dir={str(session)!r} (--network.network-dir "
        f"{session})."
    )


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
