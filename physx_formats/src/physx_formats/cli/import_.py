"""``physx import``: store the arrays of a file of another format as a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from physx_core.cli import count, options_from, show
from physx_core.observers import ProgressBar
from physx_formats import import_file


@dataclass
class Import:
    """Store the arrays of a file as the fields of a dataset.

    Arrays of the same length become the fields of one mode. Group names become part of the field
    names, except for training, validation, and prediction, which become modes.
    """

    file: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FILE")]
    """A NumPy archive (npz), an HDF5, Parquet, CSV or safetensors file, a DeepPhysX database, or
    the folder of a LeRobot dataset, or of a DeepPhysX dataset or session."""
    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DIR")]
    """The dataset's folder; rows are appended to an existing dataset that has the same fields."""
    form: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Name of the file's format; by default the one that recognizes it."""
    mode: str | None = None
    """Mode of the rows, regardless of the file's; for a file with several modes, the one to import.
    By default the file's modes, or training if it has none."""
    fields: tuple[str, ...] = ()
    """Arrays to import; by default all."""
    max_bytes: int | None = None
    """Maximum size of the arrays in bytes; by default 100 times the size of the file, but at least
    0.27 GB."""


def run(words: Sequence[str]) -> None:
    """Import a file and print the number of stored samples."""
    options = options_from(Import, words, "import")
    bar = ProgressBar()
    bar.begin("import", None, "B")
    try:
        stored = import_file(
            options.file,
            options.directory,
            form=options.form,
            mode=options.mode,
            fields=options.fields,
            max_bytes=options.max_bytes,
            advance=bar.advance,
        )
    finally:
        bar.end()
    for mode, rows in stored.items():
        show(f"{count(rows, f'{mode} sample')}: {options.directory}")
