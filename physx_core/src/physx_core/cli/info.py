"""``physx info``: show a session or dataset: fields, units, samples, normalization, integrity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physx_core import checkpoint
from physx_core.cli.dataset_tables import print_dataset
from physx_core.errors import DatasetNotFoundError


@dataclass
class Info:
    """Show what a session or dataset holds."""

    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DIR")]
    """The one folder to look into: a session's or a dataset's."""
    verify: bool = False
    """Read every byte to check that nothing was changed, not only what the files say of
    themselves."""


def run(words: Sequence[str]) -> None:
    """Print the dataset and the checkpoints of a folder.

    Raises:
        DatasetNotFoundError: The folder holds neither a dataset nor checkpoints.
        DatasetError: The dataset's manifest cannot be read.
    """
    options = tyro.cli(Info, args=words, prog="physx info")
    place = Path(options.directory)
    checkpoints = [p.parent for p in sorted(place.glob(f"network/*/{checkpoint.DESCRIPTION}"))]
    try:
        print_dataset(place, verify=options.verify)
    except DatasetNotFoundError:
        if not checkpoints:
            raise
    for path in checkpoints:
        found = checkpoint.read(path)
        print(
            f"checkpoint {path.name}: {found.network['network']}, {found.progress.epoch} epochs, "
            f"fields {', '.join(found.fields)}"
        )
