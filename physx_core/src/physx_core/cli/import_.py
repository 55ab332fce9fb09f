"""``physx import``: import an npz or HDF5 file as a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from physx_core.cli.dataset_tables import counted
from physx_core.dataset.exchange import import_file
from physx_core.observers import ProgressBar


@dataclass
class Import:
    """Store the arrays of a file as the fields of a dataset.

    Arrays of one length become the fields of one mode. Groups become part of the names, except
    those that are named training, validation or prediction: they become modes.
    """

    file: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FILE")]
    """A NumPy archive (npz) or an HDF5 file."""
    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DIR")]
    """The dataset's folder; if there is a dataset with these fields, it gets the rows added."""
    mode: str | None = None
    """Mode for the rows, whatever the file says; of a file with several modes, the one to take.
    By default the modes that the file names, or else training."""
    fields: tuple[str, ...] = ()
    """Arrays to take; by default all of them."""


def run(words: Sequence[str]) -> None:
    """Import as the words say and print what was stored.

    Raises:
        PhysxError: The file holds what a dataset cannot, or the dataset cannot be written.
    """
    options = tyro.cli(Import, args=words, prog="physx import")
    bar = ProgressBar()
    bar.begin("import", None, "B")
    try:
        stored = import_file(
            options.file,
            options.directory,
            mode=options.mode,
            fields=options.fields,
            advance=bar.advance,
        )
    finally:
        bar.end()
    for mode, rows in stored.items():
        print(f"{counted(rows, f'{mode} sample')}: {options.directory}")
