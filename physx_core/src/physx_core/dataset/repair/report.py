"""Summarizes a dataset as a table, and verifies its files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.dataset.store import manifest_file, statistics_file
from physx_core.dataset.store.episode_table import LOST
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition.commits import Kept, name_rows
from physx_core.dataset.store.partition.format import Inspection
from physx_core.errors import DatasetError
from physx_core.fields import Field


def summarize(manifest: Manifest, rows_of: Callable[[str], int]) -> list[dict[str, Any]]:
    """Return a table with one row for each field of each mode: see `Dataset.describe`.

    Args:
        manifest: The manifest.
        rows_of: Returns the number of rows of a mode.
    """
    counts = {mode_name: rows_of(mode_name) for mode_name in manifest.modes}
    return [
        {
            "mode": mode_name,
            "field": field.name,
            "role": field.role,
            "dtype": np.dtype(field.dtype).name,
            "shape": field.shape,
            "unit": field.unit,
            "axes": field.axes,
            "like": field.like,
            "samples": counts[mode_name],
            "partitions": len(mode.partitions),
            "bytes": _nbytes(mode, counts[mode_name], field),
        }
        for mode_name, mode in manifest.modes.items()
        for field in mode.fields.values()
    ]


def _nbytes(mode: Mode, rows: int, field: Field) -> int:
    """Return the bytes of a field's values; of entries, of all that are stored."""
    if not field.free_axis:
        return rows * field.nbytes
    return sum(part.rows_of(field) for part in mode.partitions if part.sizes) * field.nbytes


def find_problems(directory: Path, manifest: Manifest, content: bool = True) -> list[str]:
    """Check all files against the manifest; partitions with `content` against their checksums.

    Returns:
        One message per problem; empty for a sound dataset.
    """
    found = find_partition_problems(directory, manifest, content)
    if manifest.info.get(LOST):
        found.append(
            f"Records of episodes in {directory} were lost: no row of a mode without records "
            f"counts. Restore them from a backup, or let all rows count: update_info({LOST}=None)."
        )
    problem = find_statistics_problem(directory)
    return found if problem is None else [*found, problem]


def find_partition_problems(directory: Path, manifest: Manifest, content: bool = True) -> list[str]:
    """Check every partition file: see `find_problems`."""
    found = (
        find_problem(directory, partition, field, content)
        for mode in manifest.modes.values()
        for partition in mode.partitions
        for field in mode.files.values()
    )
    return [problem for problem in found if problem is not None]


def find_statistics_problem(directory: Path) -> str | None:
    """Return what is wrong with the file of statistics that the manifest refers to, or None."""
    manifest = _stored_manifest(directory)
    if manifest is None or manifest.statistics_checksum is None:
        return None
    checksum = manifest.statistics_checksum
    try:
        statistics_file.read(directory, manifest)
    except FileNotFoundError:
        problem = "is missing."
    except OSError as error:
        problem = f"cannot be read: {error.strerror}."
    except ValueError:
        problem = "was changed: its checksum does not match."
    else:
        return None
    now = _stored_manifest(directory)
    if now is None or now.statistics_checksum != checksum:
        return None  # a writer has just replaced it
    return (
        f"{directory / statistics_file.file_name(checksum)} {problem} No row is lost: the "
        "statistics are computed from the rows, each time until `physx verify --repair` or "
        "Dataset.repair(directory) stores them again."
    )


def _stored_manifest(directory: Path) -> Manifest | None:
    try:
        return manifest_file.load(directory, edited=True)
    except (DatasetError, FileNotFoundError):
        return None


def find_problem(
    directory: Path, partition: Partition, field: Field, content: bool = True
) -> str | None:
    """Return what is wrong with one file of a partition, or None."""
    try:
        problem = _difference(partition.inspect(directory, field), partition, field)
        if problem is None and content and not partition.sealed:
            found, kept = partition.find_rows(directory, field, thorough=True)
            problem = find_loss(found, kept)
        wanted = partition.checksums.get(field.name)
        if problem is None and content and wanted is not None:
            crc = partition.segment(directory, field).compute_checksum()
            if crc != wanted and not manifest_file.was_updated(directory, partition, field.name):
                problem = f"was changed: its rows have checksum {crc:08x}, not {wanted:08x}."
    except DatasetError as error:
        return str(error)
    return problem and f"{partition.path(directory, field.name)} {problem}"


def find_loss(found: Inspection, kept: Kept | None) -> str | None:
    """Return which rows of an open partition's file are lost or damaged, or None."""
    if kept is None:
        return "was changed: its rows do not match their recorded checksums."
    if kept.damaged:
        return f"is damaged: the bits of {name_rows(kept.damaged)} changed after they were stored."
    if not found.is_consistent:
        return (
            f"is damaged: of its rows, the number of which has changed, {kept.commit.rows} match."
        )
    if kept.commit.rows < found.rows:
        count = found.rows - kept.commit.rows
        why = "did not reach the disk" if found.was_off else "were damaged after they were stored"
        return f"counts {count} rows that {why}."
    return None


def _difference(found: Inspection, partition: Partition, field: Field) -> str | None:
    """Return how the header of a file differs from the manifest, or None."""
    have, rows = found.identity, partition.rows_of(field)
    if (have.mode, have.session, have.index) != (partition.mode, *partition.key):
        return f"belongs to another partition: {have.file_name}."
    if have.field != field:
        return f"holds {have.field}, but the manifest says {field}."
    if not partition.sealed:
        short = found.rows < rows
        return f"has {found.rows} committed rows, not {rows}." if short else None
    if not found.is_sealed_form(rows):
        return (
            f"has {found.rows} committed rows and space for {found.capacity}, but "
            f"{rows} were expected."
        )
    offset = partition.offsets[field.name]
    if found.data_offset != offset:
        return f"stores its rows at byte {found.data_offset}, but {offset} was expected."
    return None
