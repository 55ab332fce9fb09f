"""What a training that is resumed goes on with."""

from __future__ import annotations

import dataclasses

from physx_core import checkpoint
from physx_core.checkpoint import Checkpoint
from physx_core.config import DatasetConfig, EnvironmentConfig
from physx_core.errors import ConfigError
from physx_core.pipelines.storage import is_copy
from physx_core.session import Session


def last_checkpoint(
    session: Session, name: str, environment: EnvironmentConfig | None
) -> Checkpoint:
    """Return the checkpoint that a training goes on from.

    Args:
        session: The training's session.
        name: Name of the network.
        environment: What made the samples; all that are needed must be stored already.

    Raises:
        CheckpointError: There is none, or it is damaged.
        ConfigError: Environments would have to make samples.
    """
    found = checkpoint.read(checkpoint.find(session.network_dir, name, -1))
    if environment is not None:
        replays = environment.load_samples and not environment.only_first_epoch
        if environment.always_produce or replays or found.progress.epoch == 0:
            raise ConfigError(
                "A training cannot be resumed while environments make its samples: they would "
                "begin anew. Train on the stored samples: leave the environment out."
            )
    return found


def dataset_to_resume(session: Session, config: DatasetConfig) -> DatasetConfig:
    """Return the configuration without the dataset that the session has a copy of."""
    if config.existing_dir is None or not is_copy(session.dataset_dir):
        return config
    return dataclasses.replace(config, existing_dir=None)
