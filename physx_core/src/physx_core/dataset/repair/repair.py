"""Repairs a dataset without losing a sound row or deleting a file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from physx_core import files
from physx_core.dataset.read.mode_statistics import compute_statistics
from physx_core.dataset.read.ordered_statistics import store_in_order
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.virtual_index import write_index
from physx_core.dataset.repair import recovery
from physx_core.dataset.repair.quarantine import set_aside, unused
from physx_core.dataset.repair.report import (
    find_partition_problems,
    find_problem,
    find_statistics_problem,
)
from physx_core.dataset.store import locks, manifest_file, statistics_file
from physx_core.dataset.store.episode_table import EPISODES, LOST
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition.file import copy
from physx_core.errors import DatasetError
from physx_core.fields import Field


def repair(folder: Path) -> list[str]:
    """Repair a dataset and return one message per repair: see `Dataset.repair`."""
    with _lock(folder):
        manifest, done = _load_sound_manifest(folder)
        for mode in manifest.modes.values():
            for partition in list(mode.partitions):
                done += _repair_partition(folder, mode, partition)
                if partition not in mode.partitions and mode is manifest.modes.get(EPISODES):
                    manifest.info[LOST] = True
                    done.append("These rows were records of episodes, which no longer count.")
        manifest.problems.clear()
        recovery.count_rows(folder, manifest)  # a damaged partition may have hidden later ones
        done += recovery.recover(folder, manifest)
        problem = find_statistics_problem(folder)
        if problem is not None:
            statistics_file.load(folder, manifest)
            manifest.statistics_checksum = None
            done.append(f"{problem} They have been stored again.")
        if done:
            _store(folder, manifest)
        else:
            files.sync_folder(folder)  # a killed writer may have just renamed the manifest
    return done


def rebuild(folder: Path) -> None:
    """Rebuild the manifest from the partition files alone: see `Dataset.rebuild`."""
    with _lock(folder):
        _finish(folder)
        if torn := list(_unlisted_damaged_files(folder)):
            set_aside(folder, torn)
        manifest = recovery.load_from_files(folder)
        _keep_old(folder)
        recovery.recover(folder, manifest)
        _store(folder, manifest)


def _finish(folder: Path) -> None:
    """Finish what a writer left open, if the manifest is readable; the files alone do not suffice.

    Only the manifest records which partitions are being removed and which come after rows that
    did not reach the disk.
    """
    with contextlib.suppress(DatasetError):
        manifest = recovery.load(folder)
        recovery.clear_dropped(folder, manifest)
        if recovery.recover(folder, manifest):
            manifest_file.save(folder, manifest)


def _unlisted_damaged_files(folder: Path) -> Iterator[Path]:
    """Yield damaged files that the manifest does not list; a listed one is an error."""
    try:
        listed = recovery.load(folder, edited=True).file_names
    except DatasetError:
        listed = None
    for path, error in recovery.damaged_files(folder):
        if listed is None or path.name in listed:
            raise DatasetError(
                f"{error} Nothing was rebuilt. `physx verify --repair` or "
                "Dataset.repair(directory) sets unusable files aside and keeps the rest."
            ) from error
        yield path


@contextlib.contextmanager
def _lock(folder: Path) -> Iterator[None]:
    with files.storing(f"The repaired dataset in {folder}"), locks.lock(folder):
        yield


def _store(folder: Path, manifest: Manifest) -> None:
    reader = Reader(folder, manifest)
    for name in manifest.modes:
        compute_statistics(reader, name)
    write_index(reader, next(reversed(manifest.sessions), "run"))
    manifest_file.save(folder, manifest)
    store_in_order(reader)


def _load_sound_manifest(folder: Path) -> tuple[Manifest, list[str]]:
    """Return the manifest, or rebuild it from the files and set damaged ones aside."""
    path = folder / manifest_file.FILE
    if not path.exists():
        what = f"{path} was missing: it has been rebuilt from the partition files, without info."
    else:
        try:
            return recovery.load(folder), []
        except DatasetError as error:
            what = str(error)
        with contextlib.suppress(DatasetError):
            manifest = recovery.load(folder, edited=True)
            if not manifest.problems and not find_partition_problems(folder, manifest):
                for mode in manifest.modes.values():
                    mode.forget_statistics()
                return manifest, [f"{path} was edited by hand; it matches the files and is kept."]
    done = [what] + [
        _set_aside(folder, [damaged], str(error))
        for damaged, error in recovery.damaged_files(folder)
    ]
    manifest = recovery.load_from_files(folder)
    if path.exists():
        done.append(f"The old manifest is kept as {_keep_old(folder).name}.")
    return manifest, done


def _keep_old(folder: Path) -> Path:
    """Copy the manifest, if there is one, before it is replaced; return the copy's path."""
    path = folder / manifest_file.FILE
    if not path.exists():
        return path
    kept = unused(path)
    try:
        content = manifest_file.read(folder)
    except OSError:  # a link, or far too large: unusable anyway
        files.rename(path, kept)
    else:
        files.replace(kept, content)
    return kept


def _repair_partition(folder: Path, mode: Mode, partition: Partition) -> list[str]:
    """Rewrite the headers of a partition's damaged files, or else set all its files aside."""
    done = []
    for name, field in mode.files.items():
        problem = _find_damage(folder, partition, field)
        if problem is None:
            continue
        if not _has_sound_rows(folder, partition, field):
            mode.partitions.remove(partition)
            mode.forget_statistics()
            paths = [partition.path(folder, each) for each in mode.files]
            return [_set_aside(folder, paths, problem, partition.rows)]
        path, identity = partition.path(folder, name), partition.identity(field)
        offset, rows = partition.offsets[name], partition.rows_of(field)
        partition.offsets[name], _ = copy(path, offset, path, identity, rows)
        files.sync_folder(folder)
        done.append(f"{problem} Its rows are sound; its header has been rewritten.")
    return done


def _find_damage(folder: Path, partition: Partition, field: Field) -> str | None:
    """Return what is wrong with one file of a partition, or None.

    Rows of an open partition that are lost or damaged are left out when the others are sealed.
    """
    problem = find_problem(folder, partition, field, content=partition.sealed)
    if problem is None and not partition.sealed:
        _, kept = partition.find_rows(folder, field, thorough=True)
        if kept is None:
            problem = find_problem(folder, partition, field)
    return problem


def _has_sound_rows(folder: Path, partition: Partition, field: Field) -> bool:
    if not partition.sealed or field.name not in partition.checksums:
        return False
    try:
        found = partition.segment(folder, field).compute_checksum()
    except DatasetError:
        return False
    return found == partition.checksums[field.name]


def _set_aside(folder: Path, paths: list[Path], problem: str, rows: int = 0) -> str:
    place = set_aside(folder, paths)
    what = f"{rows} rows" if rows else "The remains"
    return f"{problem} {what} of the partition cannot be used and were moved to {place}."
