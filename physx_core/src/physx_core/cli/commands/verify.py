"""``physx verify``: verify and repair the files of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from physx_core.cli.dataset_tables import count
from physx_core.cli.output import show
from physx_core.dataset import EPISODES, Dataset
from physx_core.errors import DatasetError, DatasetNotFoundError


@dataclass
class Verify:
    """Check that every file of a dataset exists, is complete, and contains the written rows."""

    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DIR")]
    """A session's or a dataset's folder."""
    repair: bool = False
    """Repair first: rebuild dataset.json, finish partitions that a killed writer left open, and
    move unreadable partitions to the folder "damaged". No file is deleted."""


def run(words: Sequence[str]) -> None:
    """Print the repairs and all remaining problems."""
    options = tyro.cli(Verify, args=words, prog="physx verify")
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
