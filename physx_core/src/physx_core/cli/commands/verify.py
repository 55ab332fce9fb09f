"""``physx verify``: verify and repair a dataset; verify what a network was trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physx_core import checkpoint
from physx_core.cli.dataset_tables import count
from physx_core.cli.options import options_from
from physx_core.cli.output import show
from physx_core.dataset import EPISODES, Dataset
from physx_core.errors import DatasetError, DatasetNotFoundError, UsageError
from physx_core.pipelines.learning.data_record import (
    describe_changes,
    describe_record,
    open_data,
    read_last_batch,
)


@dataclass
class Verify:
    """Check that every file of a dataset exists, is complete, and contains the written rows.

    Of a checkpoint, check that its files and the data that it was trained on are as recorded.
    """

    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DIR")]
    """The folder of a session, a dataset, or a checkpoint."""
    repair: bool = False
    """Repair first: rebuild dataset.json, finish partitions that a killed writer left open, and
    move unreadable partitions to the folder "damaged". No file is deleted."""
    read: bool = False
    """Of a checkpoint: also read all rows of its data, and compare them with their checksums."""
    replay: bool = False
    """Of a checkpoint: also read the last batch that it learned from again, and compare it."""


def run(words: Sequence[str]) -> None:
    """Print the repairs and all remaining problems."""
    options = options_from(Verify, words, "verify")
    if checkpoint.is_one(Path(options.directory)):
        _verify_checkpoint(Path(options.directory), options)
        return
    if options.read or options.replay:
        raise UsageError(
            "--read and --replay are for the folder of a checkpoint, such as "
            f"{options.directory}/network/network_0; rows of a dataset are always read."
        )
    if options.repair:
        for text in Dataset.repair(options.directory):
            show(f"repaired: {text}")
    problems, checked = _problems(options.directory)
    for text in problems:
        show(text)
    if problems:
        advice = "" if options.repair else " physx verify DIR --repair repairs what it can."
        raise DatasetError(f"{options.directory} has {count(len(problems), 'problem')}.{advice}")
    show(f"sound: {checked}")


def _verify_checkpoint(path: Path, options: Verify) -> None:
    """Print whether a checkpoint, and the data that it was trained on, are as recorded."""
    if options.repair:
        raise UsageError("--repair is for a dataset; a checkpoint cannot be repaired.")
    found = checkpoint.read(path)
    show(f"files: as recorded, {found.progress.epoch} epochs")
    if not found.progress.data:
        show("data: not recorded")
        return
    how = "read and compared with their checksums" if options.read else "as recorded"
    with open_data(path.parent.parent) as (datasets, config):
        progress = found.progress
        problems = describe_changes(progress.data, datasets, config.mode, progress.snapshots)
        for dataset in datasets.values() if options.read else ():
            problems += dataset.verify()
        if not problems:
            show(f"data: {describe_record(progress.data)}, {how}")
        if options.replay:
            again, before = read_last_batch(found, datasets, config), progress.last_batch
            if again == before:
                show(f"batch {before['number']}, its last: read again, with the same values")
            else:
                problems.append(f"batch {before['number']}, its last, has other values")
    for text in problems:
        show(text)
    if problems:
        raise DatasetError(
            f"The data of {path} are not as they were: {count(len(problems), 'difference')}."
        )


def _problems(directory: str) -> tuple[list[str], str]:
    """Return the problems, and a summary of the checked files."""
    try:
        with Dataset.open(directory) as dataset:
            problems = dataset.verify()
            rows, has_table = dataset.describe(), dataset.has_episodes
    except DatasetNotFoundError:
        raise
    except DatasetError as error:
        return [str(error)], ""
    files = sum(row["partitions"] for row in rows)
    kinds = {row["mode"]: f"{row['mode']} sample" for row in rows}
    if has_table:
        kinds[EPISODES] = "record"
    samples = {row["mode"]: count(row["samples"], kinds[row["mode"]]) for row in rows}
    return problems, f"{count(files, 'file')}, {', '.join(samples.values()) or 'no samples'}"
