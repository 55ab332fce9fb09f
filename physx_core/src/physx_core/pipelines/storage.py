"""Opening the datasets that pipelines write to and read from."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from physx_core.config import WRONG, DatasetConfig, EnvironmentConfig, to_plain
from physx_core.dataset import Dataset
from physx_core.errors import ConfigError, DatasetNotFoundError, UsageError, WrongSamplesError
from physx_core.plugins import reference_of
from physx_core.session import Session, installed_versions
from physx_core.sources.source import Source

PARAMETERS = "parameters_{}.bin"
"""Name of the file beside a dataset that holds what an instance saved."""


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


def check_sources(config: DatasetConfig, environment: EnvironmentConfig | None) -> None:
    """Check that a training's samples come from one place.

    Raises:
        ConfigError: They do not.
    """
    if environment is None:
        return
    if config.mode == WRONG:
        raise ConfigError(
            'The mode "wrong" holds samples that check_sample rejected: environments neither make '
            "them nor replay them for a training. To look at them: physx replay."
        )
    if environment.load_samples and environment.always_produce:
        raise ConfigError(
            "load_samples replays stored samples and always_produce makes new ones: choose one. "
            "To replay in every epoch, set only_first_epoch=False."
        )
    if config.existing_dir is not None and not environment.load_samples:
        raise ConfigError(
            "A training takes its samples from existing_dir or from an environment, not both. To "
            "send the stored samples through the environment, set load_samples=True."
        )


def reject_environments(environment: EnvironmentConfig) -> None:
    """Tell why environments cannot take part in a training of several processes.

    Raises:
        ConfigError: Always, with the way to the same training.
    """
    replays = environment.load_samples
    if environment.always_produce or (replays and not environment.only_first_epoch):
        advice = (
            "take part in every epoch. Leave out always_produce and only_first_epoch=False, or "
            "train in one process."
        )
    else:
        what = "send the stored samples through them" if replays else "let them make the samples"
        advice = (
            f"take part in the first epoch. First {what} in one process, with epoch_nb=1; then "
            "several go on with resume=True (physx train --resume)."
        )
    raise ConfigError(
        "Several processes train on stored samples only, each on its share, but environments "
        f"shall {advice}"
    )


def copy_existing(dataset: Dataset, config: DatasetConfig) -> None:
    """Copy an existing dataset into a session's own one: all rows, and the environments' values.

    The existing one is not changed. Rows that lie in whole partitions are copied by the system,
    which shares them on the disk where the file system can.

    Args:
        dataset: The session's own dataset, open for writing.
        config: Names the existing one; None: the session's own samples are there already.

    Raises:
        ConfigError: The session's own dataset has samples of its own.
        DatasetNotFoundError: There is no such dataset.
        DatasetError: It is damaged, or the disk is full.
    """
    if config.existing_dir is None:
        return
    if any(dataset.num_samples(mode) for mode in dataset.modes):
        raise ConfigError(
            "The session has samples of its own already, so it cannot begin with a copy of "
            f"{config.existing_dir}. To go on with its own, leave existing_dir out; otherwise "
            "take a new session."
        )
    dataset.merge(config.existing_dir)
    with Dataset.open(config.existing_dir) as existing:
        dataset.update_info(**existing.info, copied_from=str(existing.directory))
        for path in existing.directory.glob(PARAMETERS.format("*")):
            shutil.copyfile(path, dataset.directory / path.name)


def is_copy(directory: Path) -> bool:
    """Return whether a dataset began as a copy of another one."""
    with contextlib.suppress(DatasetNotFoundError), Dataset.open(directory) as dataset:
        return "copied_from" in dataset.info
    return False


@contextlib.contextmanager
def record_rejected(source: Source, dataset: Dataset | None) -> Iterator[None]:
    """Store what `check_sample` rejects of the batch that is made meanwhile, behind the batch.

    It goes to the mode "wrong", also where too many rejected samples end the run. If the batch
    cannot be made for another reason, what was rejected is not stored either.

    Args:
        source: Makes the batch.
        dataset: Gets the samples; None: they are forgotten.
    """
    try:
        yield
    except WrongSamplesError:
        _store_rejected(source, dataset)
        raise
    _store_rejected(source, dataset)


def _store_rejected(source: Source, dataset: Dataset | None) -> None:
    rows = source.pop_rejected()
    if rows and dataset is not None:
        dataset.define_fields(WRONG, source.fields)
        dataset.append(WRONG, rows, checked=True)


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
