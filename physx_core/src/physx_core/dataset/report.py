"""What a dataset holds, as a table, and whether its files are sound."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from physx_core.dataset.layout import inspect
from physx_core.dataset.manifest import Manifest, Partition
from physx_core.dataset.reader import Segment
from physx_core.dataset.sealing import checksum
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


def find_problems(directory: Path, manifest: Manifest) -> list[str]:
    """Check every partition file against the manifest and its checksum.

    Returns:
        One text for each problem; empty for a sound dataset.
    """
    problems = []
    for mode_name, mode in manifest.modes.items():
        for partition in mode.partitions:
            for field in mode.fields.values():
                try:
                    problem = _problem(directory, mode_name, partition, field)
                except DatasetError as error:
                    problem = str(error)
                if problem:
                    problems.append(problem)
    return problems


def _problem(directory: Path, mode_name: str, partition: Partition, field: Field) -> str | None:
    path = directory / partition.file_name(mode_name, field.name)
    found = inspect(path, partition.offsets.get(field.name), field.nbytes)
    have, want = found.identity, partition.identity(mode_name, field)
    if (have.session, have.mode, have.index) != (want.session, want.mode, want.index):
        return f"{path} belongs to another partition: {have.file_name}."
    if have.field != want.field:
        return f"{path} holds {have.field}, but the manifest says {want.field}."
    if found.rows < partition.rows or (partition.sealed and found.rows != partition.rows):
        return f"{path} has {found.rows} committed rows, but {partition.rows} were expected."
    if not partition.sealed:
        return None
    rows = Segment(path, 0, partition.rows, partition.offsets[field.name], certain=True)
    crc = checksum(rows, field.nbytes)
    if crc != partition.checksums.get(field.name):
        wanted = partition.checksums.get(field.name, 0)
        return f"{path} was changed: its rows have checksum {crc:08x}, not {wanted:08x}."
    return None
