"""``physx info``: show a session or dataset: fields, units, samples, normalization, integrity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physx_core import checkpoint
from physx_core.cli.dataset_tables import print_dataset
from physx_core.cli.output import show
from physx_core.errors import CheckpointError, DatasetNotFoundError


@dataclass
class Info:
    """Show the contents of a session or dataset."""

    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DIR")]
    """A session's or a dataset's folder; give one folder."""
    verify: bool = False
    """Check every byte, not only sizes and headers."""


def run(words: Sequence[str]) -> None:
    """Print the dataset and the checkpoints of a folder."""
    options = tyro.cli(Info, args=words, prog="physx info")
    place = Path(options.directory)
    checkpoints = checkpoint.list_all(place / "network")
    try:
        print_dataset(place, verify=options.verify)
    except DatasetNotFoundError:
        if not checkpoints:
            raise
    problems = 0
    for path in checkpoints:
        try:
            found = checkpoint.read(path, content=options.verify)
        except CheckpointError as error:
            problems += 1
            show(f"checkpoint {path.name}: {error}")
            continue
        show(
            f"checkpoint {path.name}: {found.network['network']}, {found.progress.epoch} epochs, "
            f"fields {', '.join(found.fields)}"
        )
    if problems and problems == len(checkpoints):
        raise CheckpointError(f"None of the checkpoints in {place / 'network'} can be read.")
