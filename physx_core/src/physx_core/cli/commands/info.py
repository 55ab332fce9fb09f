"""``physx info``: show what a session or dataset contains."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physx_core import checkpoint
from physx_core.cli.dataset_tables import print_dataset
from physx_core.cli.options import options_from
from physx_core.cli.output import show
from physx_core.errors import CheckpointError, DatasetNotFoundError, PhysxError, UsageError
from physx_core.pipelines.learning.data_record import (
    describe_changes,
    describe_record,
    open_data,
)
from physx_core.results import read_results


@dataclass
class Info:
    """Show the contents of a session or dataset; physx doctor shows what is installed."""

    directory: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="DIR")] = None
    """A session's or a dataset's folder."""
    verify: bool = False
    """Check every byte, not only sizes and headers."""


def run(words: Sequence[str]) -> None:
    """Print a folder's dataset and checkpoints.

    Raises:
        UsageError: If no folder is named.
    """
    options = options_from(Info, words, "info")
    if options.directory is None:
        raise UsageError(
            "physx info needs a folder: physx info SESSION. What is installed: physx doctor."
        )
    _show_session(Path(options.directory), options)


def _data_of(place: Path, found: checkpoint.Checkpoint) -> Iterator[str]:
    """Yield what data a network was trained on, and whether they changed since."""
    progress = found.progress
    if not progress.data:
        return
    yield f"trained on {describe_record(progress.data)}"
    try:
        with open_data(place) as (datasets, config):
            changes = describe_changes(progress.data, datasets, config.mode)
            places = ", ".join(str(dataset.directory) for dataset in datasets.values())
            yield f"data in {places}: {'; '.join(changes) or 'unchanged since'}"
    except PhysxError as error:
        yield f"whether they changed since is not known: {error}"


def _show_session(place: Path, options: Info) -> None:
    checkpoints = checkpoint.list_all(place / "network")
    try:
        print_dataset(place, verify=options.verify)
    except DatasetNotFoundError:
        if not checkpoints:
            raise
    for kind, result in read_results(place).items():
        show(f"result of the last {kind}, {result.seconds:.3g} s")
        for line in result.lines:
            show(f"  {line}")
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
        for line in _data_of(place, found):
            show(f"  {line}")
    if problems and problems == len(checkpoints):
        raise CheckpointError(f"None of the checkpoints in {place / 'network'} can be read.")
