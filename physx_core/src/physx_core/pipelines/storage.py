"""Opening the datasets that pipelines write to and read from."""

from __future__ import annotations

import contextlib
from typing import Any

from physx_core.config import DatasetConfig, EnvironmentConfig, to_plain
from physx_core.dataset import Dataset
from physx_core.errors import DatasetNotFoundError, UsageError
from physx_core.plugins import reference_of
from physx_core.session import Session, installed_versions


def open_own(session: Session, config: DatasetConfig) -> Dataset:
    """Open a session's own dataset for writing; make it if it is not there.

    Raises:
        DatasetError: It is damaged, or another process writes to it.
    """
    if (session.dataset_dir / "dataset.json").exists():
        return Dataset.open(
            session.dataset_dir,
            writable=True,
            session=session.name,
            max_file_size=config.max_file_size,
        )
    return Dataset.create(
        session.dataset_dir, session=session.name, max_file_size=config.max_file_size
    )


def open_existing(session: Session, config: DatasetConfig) -> Dataset:
    """Open the dataset that a configuration names, or else the session's own, for reading.

    Raises:
        DatasetNotFoundError: There is none.
    """
    try:
        return Dataset.open(config.existing_dir or session.dataset_dir)
    except DatasetNotFoundError as error:
        if config.existing_dir is None:
            error.add_note(
                "Name a session or dataset in DatasetConfig.existing_dir, or an environment that "
                "makes the samples."
            )
        raise


def describe_environment(config: EnvironmentConfig, seed: int) -> dict[str, Any]:
    """Return what a dataset keeps of the environment that made its samples."""
    plain = to_plain(config)
    reference = plain["environment"]
    with contextlib.suppress(UsageError):  # a class that only this process can find
        reference = reference_of(config.environment)
    return {
        "environment": reference,
        "env_kwargs": plain["env_kwargs"],
        "num_clients": config.num_clients,
        "simulations_per_step": config.simulations_per_step,
        "seed": seed,
        "versions": installed_versions(),
    }
