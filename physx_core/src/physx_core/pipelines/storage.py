"""Opens and checks the datasets that pipelines write and read, and removes unused ones."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from physx_core import files
from physx_core.config import SETS, WRONG, EnvironmentConfig, to_plain
from physx_core.dataset import Dataset
from physx_core.dataset.store.locks import LOCK
from physx_core.dataset.store.manifest_file import FILE
from physx_core.dataset.write.delegation import PROOF
from physx_core.errors import (
    ConfigError,
    DatasetNotFoundError,
    PhysxError,
    UsageError,
    WrongSamplesError,
    listed,
)
from physx_core.observers import read_scalars
from physx_core.pipelines.saved_parameters import BEGUN, copy_parameters
from physx_core.plugins import reference_of
from physx_core.session import NOTES, Session, installed_versions, related_sessions
from physx_core.sources.source import Source
from physx_core.views.dataset_config import DatasetConfig

_IF_SET = ("independent_episodes", "episode_steps", "sampler", "sampler_kwargs", "state_every")
GENERATION = "generation"
"""Entry in a dataset's info that describes the last training whose environments generated rows."""
STREAMS = "streams"
"""Entry that describes the last data generation by streams."""
GENERATIONS = (GENERATION, STREAMS)
EPISODE_OPTIONS = (
    *("environment", "env_kwargs", "independent_episodes", "episode_steps"),
    *("simulations_per_step", "sampler", "sampler_kwargs"),
)
"""Options of an environment on which the rows of an episode depend, except its seed."""


def open_own(session: Session, config: DatasetConfig) -> Dataset:
    """Open a session's own dataset for writing, creating it if it does not exist."""
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
    """Open the dataset that a configuration names, by default the session's own, for reading."""
    named = next(iter(config.view.sources), config.existing_dir)
    try:
        return Dataset.open(named or session.dataset_dir)
    except DatasetNotFoundError as error:
        if named is None:
            error.add_note(
                "Name a session or dataset in DatasetConfig.existing_dir, or an environment that "
                f"generates the samples.{other_samples(session.dataset_dir, config.mode)}"
            )
        raise


def other_samples(directory: Path, mode: str) -> str:
    """Return a sentence that names the related, numbered sessions that have samples of a mode.

    Args:
        directory: A session's dataset.
        mode: The mode, of which this dataset has no samples.

    Returns:
        The sentence, with a leading space; empty if there is no such session.
    """
    found = []
    for other in related_sessions(directory.parent) if directory.name == "dataset" else ():
        with contextlib.suppress(PhysxError, OSError), Dataset.open(other / "dataset") as dataset:
            count = dataset.num_samples(mode)
            found += [f"{other} ({count:,})"] if count else []
    return f" There are such samples in {', '.join(found)}." if found else ""


def remove_unused(session: Session, *, opened: bool) -> bool:
    """Remove a new session if its failed run stored nothing in it; return whether it was removed.

    The session stays if it contains samples, parameters of an environment, a checkpoint,
    statistics, a recording, notes, or any unknown file.

    Args:
        session: The run's session.
        opened: Whether the pipeline was open. If not, the dataset contains only copied data.
    """
    if not session.is_new or not session.path.is_dir():
        return False
    try:
        if not all(_is_unused(session, path, opened) for path in session.path.rglob("*")):
            return False
        files.remove_folder(session.path)
    except (OSError, UnicodeDecodeError, PhysxError):  # keep anything that cannot be read
        return False
    return True


def _is_unused(session: Session, path: Path, opened: bool) -> bool:
    """Return whether a file or folder was created when the session opened and is still empty."""
    if path.is_dir() and not path.is_symlink():
        return True
    match path.relative_to(session.path).parts:
        case ("config.toml",):
            return True
        case ("info.txt",):
            return NOTES in path.read_text(encoding="utf-8")
        case ("dataset", name):
            is_data = name == FILE or path.suffix == ".h5"
            is_empty = is_data and not _has_samples(path.parent)
            return not opened or name in (LOCK, PROOF, BEGUN) or is_empty
        case ("stats", *_):
            numbers = session.stats_dir / "scalars.csv"
            return not numbers.exists() or not read_scalars(session.path)
        case ("network", name, *_):
            return name.endswith(".partial")
    return False


def _has_samples(directory: Path) -> bool:
    with Dataset.open(directory) as dataset:
        return any(dataset.num_samples(mode) for mode in dataset.modes)


def check_sources(config: DatasetConfig, environment: EnvironmentConfig | None) -> None:
    """Check that a training's samples come from one place."""
    if config.view.sources and config.existing_dir is not None:
        raise ConfigError(
            "Training takes its samples from existing_dir or from the sources of its view, not "
            "both: give existing_dir a share among DatasetConfig.view.sources."
        )
    if environment is None:
        return
    if config.mode == WRONG:
        raise ConfigError(
            'The mode "wrong" contains samples that check_sample rejected: environments neither '
            "generate nor replay them for training. To view them: physx replay."
        )
    if environment.load_samples and environment.always_produce:
        raise ConfigError(
            "load_samples replays stored samples and always_produce generates new ones: choose "
            "one. To replay in every epoch, set only_first_epoch=False."
        )
    if config.existing_dir is not None and not environment.load_samples:
        raise ConfigError(
            "Training takes its samples from existing_dir or from an environment, not both. To "
            "send the stored samples through the environment, set load_samples=True."
        )


def check_client_writers(config: EnvironmentConfig) -> None:
    """Check that the clients of a data generation can write their own rows."""
    clients = "DatasetConfig.writers='clients' has each client write its own rows"
    if not config.as_tcp_ip_client:
        raise ConfigError(
            f"{clients}, but as_tcp_ip_client=False starts none. Use writers='server'."
        )


def reject_streams_of_writers(what: str) -> None:
    """Reject the option that clients write their own rows if what they run is a stream."""
    raise ConfigError(
        "DatasetConfig.writers='clients' needs independent episodes, but "
        f"{what} is a stream here. If nothing but an episode's "
        "parameters and random stream influences its rows, set independent_episodes=True, or "
        "episode_steps, and leave out an own batch_produce(); otherwise use writers='server'."
    )


def reject_client_writers(config: DatasetConfig, what: str) -> None:
    """Reject the option that clients write their own rows if the run itself needs the rows."""
    if config.writers != "server":
        raise ConfigError(
            f"DatasetConfig.writers='clients' is for data generation: {what} needs the rows in the "
            "run's own process. Generate the samples first, then read them with existing_dir."
        )


def reject_episode_fields(source: Source) -> None:
    """Reject fields that episodes have once if the samples that are generated are of streams."""
    if source.episode_fields:
        names = listed(field.name for field in source.episode_fields)
        raise ConfigError(
            f"The environment sets {names} once in each independent episode, but its samples are "
            "generated by streams here. Leave out independent_episodes=False "
            "and an own batch_produce(), or define additional fields instead."
        )


def reject_environments(environment: EnvironmentConfig) -> None:
    """Reject environments that replay samples when several processes train together."""
    if not environment.load_samples:
        return
    advice = (
        "First send the stored samples through them in one process, with epoch_nb=1; then continue "
        "in several processes with resume=True (physx train --resume)."
    )
    if not environment.only_first_epoch:
        advice = "Leave out only_first_epoch=False, or train in one process."
    raise ConfigError(f"Environments cannot replay samples for several processes. {advice}")


def copy_existing(dataset: Dataset, config: DatasetConfig) -> None:
    """Copy an existing dataset into a session's own: all rows and the environments' parameters.

    The existing dataset is not changed. The operating system copies rows in whole partitions, which
    share their disk space if the file system supports it.

    Args:
        dataset: The session's own dataset, open for writing.
        config: Names the existing dataset, if any.
    """
    if config.existing_dir is None:
        return
    if any(dataset.num_samples(mode) for mode in dataset.modes):
        raise ConfigError(
            "The session already has its own samples, so it cannot start with a copy of "
            f"{config.existing_dir}. To continue with its own, leave out existing_dir; otherwise "
            "use a new session."
        )
    dataset.merge(config.existing_dir)
    with Dataset.open(config.existing_dir) as existing:
        copied = {"copied_from": str(existing.directory)}
        dataset.update_info(**existing.info | dict.fromkeys(GENERATIONS) | copied)
        copy_parameters(existing.directory, dataset.directory)


def is_copy(directory: Path) -> bool:
    """Return whether a dataset was copied from another one."""
    with contextlib.suppress(DatasetNotFoundError), Dataset.open(directory) as dataset:
        return "copied_from" in dataset.info
    return False


def record_beside_rows(
    source: Source, dataset: Dataset | None, mode: str, earlier: Mapping[int, int] | None = None
) -> contextlib.AbstractContextManager[None]:
    """Store what a source produces in addition to the rows of a batch.

    These are the samples that `check_sample` rejects during the body, in the mode "wrong", and the
    sets of parameters that begin in its batch, in the mode "parameters". They are stored after the
    body's batch, or the sets before its rows if the body calls `store_sets`. Rejected samples are
    stored even if too many of them end the run; if it fails for another reason, they are not.

    Args:
        source: Generates the batch.
        dataset: Stores the samples; None: they are discarded.
        mode: Mode of the batch.
        earlier: Instance to the step of its last row before the batch, if a run was killed before
            it stored the samples rejected up to then: these are stored first. None: there are none.
    """
    if source.is_plain:
        return contextlib.nullcontext()
    return _recording_beside_rows(source, dataset, mode, earlier)


@contextlib.contextmanager
def _recording_beside_rows(
    source: Source, dataset: Dataset | None, mode: str, earlier: Mapping[int, int] | None
) -> Iterator[None]:
    try:
        yield
    except WrongSamplesError:
        with contextlib.suppress(PhysxError):  # the run's own error matters more
            _store_rejected(source, dataset, earlier)
        raise
    _store_rejected(source, dataset, earlier)
    store_sets(source, dataset, mode)


def last_steps(dataset: Dataset, mode: str, first: int, stop: int, count: int) -> dict[int, int]:
    """Return the step of each instance's last row among stored rows of streams.

    Args:
        dataset: Contains the rows.
        mode: Their mode.
        first: Index of the first row of the streams.
        stop: Index behind their last row.
        count: Number of streams.
    """
    if stop <= first:
        return {}
    last = slice(max(first, stop - count), stop)
    numbers, steps = (dataset[mode][name][last].tolist() for name in ("env_id", "step"))
    return dict(zip(numbers, steps, strict=True))


def _store_rejected(
    source: Source, dataset: Dataset | None, earlier: Mapping[int, int] | None
) -> None:
    rows = source.pop_rejected()
    if not rows or dataset is None:
        return
    dataset.define_fields(WRONG, source.fields)
    last = [(earlier or {}).get(number, -1) for number in rows["env_id"].tolist()]
    is_left = rows["step"] < last
    for chosen in (is_left, ~is_left):
        if chosen.any():
            part = {name: values[chosen] for name, values in rows.items()}
            dataset.append(WRONG, part, checked=True)


def store_sets(source: Source, dataset: Dataset | None, mode: str) -> None:
    """Store the sets of parameters that begin in a source's last batch.

    They are stored before its rows, so rows have their parameters even if the process is killed.
    """
    sets = source.sets.pop(mode)
    if dataset is not None and sets:
        dataset.define_fields(SETS, source.sets.fields)
        dataset.append(SETS, sets)


def end_generation(dataset: Dataset, *entries: str) -> None:
    """Record where the rows end that the streams of earlier runs generated.

    Called before another run adds rows, so that they can still be resumed if they need no more
    rows.

    Args:
        dataset: The dataset, open for writing.
        entries: Which runs: `GENERATION`, `STREAMS`.
    """
    for entry in entries:
        last = dataset.info.get(entry)
        if isinstance(last, dict) and last.get("ended") is None:
            counted = (str(last.get("mode")), WRONG, SETS)
            ended = [dataset.num_samples(name) for name in counted]
            dataset.update_info(**{entry: {**last, "ended": ended}})


def describe_environment(config: EnvironmentConfig, seed: int) -> dict[str, Any]:
    """Return the description of the environment that is stored in the dataset of its samples."""
    plain = to_plain(config)
    reference = plain["environment"]
    with contextlib.suppress(UsageError):  # a class that only this process can find
        reference = reference_of(config.environment)
    return {
        "environment": reference,
        "env_kwargs": plain["env_kwargs"],
        "num_clients": config.num_clients,
        "simulations_per_step": config.simulations_per_step,
        **{name: plain[name] for name in _IF_SET if plain.get(name)},
        "seed": seed,
        "versions": dict(installed_versions()),
    }
