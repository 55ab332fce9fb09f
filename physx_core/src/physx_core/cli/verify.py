"""``physx verify``: verify the files of a dataset, and repair them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from physx_core.cli.dataset_tables import counted
from physx_core.dataset import Dataset
from physx_core.errors import DatasetError, DatasetNotFoundError


@dataclass
class Verify:
    """Check every file of a dataset: there, whole, and of the rows that were written."""

    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DIR")]
    """A session's or a dataset's folder."""
    repair: bool = False
    """First put right what can be: rebuild dataset.json, finish what a killed writer left open,
    move partitions that cannot be read to the folder "damaged". No file is deleted."""


def run(words: Sequence[str]) -> None:
    """Print what was repaired and each problem that is left.

    Raises:
        DatasetError: There is no dataset, or it has problems.
    """
    options = tyro.cli(Verify, args=words, prog="physx verify")
    if options.repair:
        for text in Dataset.repair(options.directory):
            print(f"repaired: {text}")
    problems, checked = _problems(options.directory)
    for text in problems:
        print(text)
    if problems:
        advice = "" if options.repair else " physx verify DIR --repair puts right what can be."
        raise DatasetError(f"{options.directory} has {counted(len(problems), 'problem')}.{advice}")
    print(f"sound: {checked}")


def _problems(directory: str) -> tuple[list[str], str]:
    """Return the problems, and what was checked."""
    try:
        with Dataset.open(directory) as dataset:
            problems = dataset.verify()
            rows = dataset.describe()
    except DatasetNotFoundError:
        raise
    except DatasetError as error:
        return [str(error)], ""
    files = sum(row["partitions"] for row in rows)
    samples = {row["mode"]: counted(row["samples"], f"{row['mode']} sample") for row in rows}
    return problems, f"{counted(files, 'file')}, {', '.join(samples.values()) or 'no samples'}"
