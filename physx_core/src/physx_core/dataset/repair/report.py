"""What a dataset holds, as a table, and whether its files are sound."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from physx_core.dataset.read.reader import Segment
from physx_core.dataset.store.manifest import Manifest, Partition
from physx_core.dataset.store.partition_format import Identity, Inspection, inspect
from physx_core.dataset.store.sealing import checksum
from physx_core.errors import DatasetError
from physx_core.fields import Field


def summarize(manifest: Manifest) -> list[dict[str, Any]]:
    """Return one row of a table for each field of each mode: see `Dataset.describe`."""
    return [
        {
            "mode": mode_name,
            "field": field.name,
            "role": field.role,
            "dtype": np.dtype(field.dtype).name,
            "shape": field.shape,
            "unit": field.unit,
            "samples": mode.rows,
            "partitions": len(mode.partitions),
            "bytes": mode.rows * field.nbytes,
        }
        for mode_name, mode in manifest.modes.items()
        for field in mode.fields.values()
    ]


def find_problems(directory: Path, manifest: Manifest, content: bool = True) -> list[str]:
    """Check every partition file against the manifest and, with `content`, its checksum.

    Returns:
        One text for each problem; empty for a sound dataset.
    """
    problems = []
    for mode_name, mode in manifest.modes.items():
        for partition in mode.partitions:
            for field in mode.fields.values():
                problem = problem_of(directory, mode_name, partition, field, content)
                if problem is not None:
                    problems.append(problem)
    return problems


def problem_of(
    directory: Path, mode_name: str, partition: Partition, field: Field, content: bool = True
) -> str | None:
    """Return what is wrong with one file of a partition, or None."""
    path = directory / partition.file_name(mode_name, field.name)
    try:
        found = inspect(path, partition.offsets.get(field.name), field.nbytes)
        problem = _difference(found, partition, partition.identity(mode_name, field))
        if problem is None and content and partition.checksums:
            problem = _change(path, partition, field)
    except DatasetError as error:
        return str(error)
    return problem and f"{path} {problem}"


def _difference(found: Inspection, partition: Partition, want: Identity) -> str | None:
    """Return in what the header of a file differs from the manifest."""
    have = found.identity
    if (have.session, have.mode, have.index) != (want.session, want.mode, want.index):
        return f"belongs to another partition: {have.file_name}."
    if have.field != want.field:
        return f"holds {have.field}, but the manifest says {want.field}."
    if not partition.sealed:
        short = found.rows < partition.rows
        return f"has {found.rows} committed rows, not {partition.rows}." if short else None
    if found.rows != partition.rows or found.capacity != partition.rows:
        return (
            f"has {found.rows} committed rows and space for {found.capacity}, but "
            f"{partition.rows} were expected."
        )
    offset = partition.offsets[want.field.name]
    if found.data_offset != offset:
        return f"has its rows at byte {found.data_offset}, but {offset} was expected."
    return None


def _change(path: Path, partition: Partition, field: Field) -> str | None:
    """Return how the rows of a file differ from those that were sealed."""
    rows = Segment(path, 0, partition.rows, partition.offsets[field.name], certain=True)
    crc, wanted = checksum(rows, field.nbytes), partition.checksums[field.name]
    if crc == wanted:
        return None
    return f"was changed: its rows have checksum {crc:08x}, not {wanted:08x}."
