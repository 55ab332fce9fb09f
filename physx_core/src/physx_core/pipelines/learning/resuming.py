"""Finds the checkpoint and the dataset that a training resumes from."""

from __future__ import annotations

import dataclasses

from physx_core import checkpoint
from physx_core.checkpoint import Checkpoint
from physx_core.config import DatasetConfig, EnvironmentConfig
from physx_core.errors import ConfigError
from physx_core.pipelines.storage import is_copy
from physx_core.session import Session


def read_last_checkpoint(
    session: Session, name: str, environment: EnvironmentConfig | None
) -> Checkpoint:
    """Return the checkpoint that a training resumes from.

    Args:
        session: The training's session.
        name: Name of the network.
        environment: The environment of the samples; all needed samples must be stored already.
    """
    found = checkpoint.find(session.network_dir, name, -1)
    if not can_resume(environment, found.progress.epoch):
        raise ConfigError(
            "A training cannot be resumed while environments generate its samples, as they would "
            f"start over. Leave the environment out to train on the stored samples, or start "
            f"another training with its network: NetworkConfig.network_dir={str(session.path)!r} "
            f"(--network.network-dir {session.path})."
        )
    return found


def can_resume(environment: EnvironmentConfig | None, epochs: int) -> bool:
    """Return whether a training that has finished some epochs needs its environments no more."""
    if environment is None:
        return True
    replays = environment.load_samples and not environment.only_first_epoch
    return epochs > 0 and not replays and not environment.always_produce


def without_copied_dataset(session: Session, config: DatasetConfig) -> DatasetConfig:
    """Return the configuration without an existing dataset that the session has a copy of."""
    if config.existing_dir is None or not is_copy(session.dataset_dir):
        return config
    return dataclasses.replace(config, existing_dir=None)
