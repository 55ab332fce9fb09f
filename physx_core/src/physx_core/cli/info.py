"""``physx info``: what a session or dataset holds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from physx_core import checkpoint
from physx_core.errors import DatasetNotFoundError, UsageError


def run(words: Sequence[str]) -> None:
    """Print the dataset's table and the checkpoints of a folder.

    Raises:
        UsageError: Not just one folder was named.
        DatasetNotFoundError: The folder holds neither a dataset nor checkpoints.
    """
    if words and words[0] in ("-h", "--help"):
        print("usage: physx info DIR\n\nDIR is a session's or a dataset's folder.")
        return
    if len(words) != 1:
        raise UsageError("physx info takes one folder: physx info DIR")
    place = Path(words[0])
    checkpoints = [p.parent for p in sorted(place.glob(f"network/*/{checkpoint.DESCRIPTION}"))]
    try:
        _print_dataset(place)
    except DatasetNotFoundError:
        if not checkpoints:
            raise
    for path in checkpoints:
        found = checkpoint.read(path)
        print(
            f"checkpoint {path.name}: {found.network['network']}, {found.progress.epoch} epochs, "
            f"fields {', '.join(found.fields)}"
        )


def _print_dataset(place: Path) -> None:
    from physx_core.dataset import Dataset

    with Dataset.open(place) as dataset:
        rows = dataset.describe()
        info = dataset.info
    print(f"dataset {place}")
    for key in ("environment", "env_kwargs", "num_clients", "seed"):
        if info.get(key) not in (None, {}):
            print(f"  {key}: {info[key]}")
    _print_table(rows)


def _print_table(rows: Sequence[dict[str, object]]) -> None:
    if not rows:
        print("  no samples")
        return
    names = list(rows[0])
    cells = [names, *([str(row[name]) for name in names] for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(names))]
    for line in cells:
        parts = (f"{cell:{width}}" for cell, width in zip(line, widths, strict=True))
        print("  " + "  ".join(parts).rstrip())
