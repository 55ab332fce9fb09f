"""Repairing a dataset: whatever can be put right without losing a row or deleting a file."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from physx_core import files
from physx_core.dataset.read.reader import Reader, Segment
from physx_core.dataset.repair import recovery
from physx_core.dataset.repair.report import find_problems, problem_of
from physx_core.dataset.store import manifest_file
from physx_core.dataset.store import mode_statistics as coverage
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition_file import rewrite
from physx_core.dataset.store.sealing import checksum
from physx_core.dataset.store.virtual_index import write_index
from physx_core.errors import DatasetError
from physx_core.fields import Field

ASIDE = "damaged"


def repair(folder: Path) -> list[str]:
    """Repair a dataset and return what was done: see `Dataset.repair`."""
    with _locked(folder):
        manifest, done = _sound_manifest(folder)
        for name, mode in manifest.modes.items():
            for partition in list(mode.partitions):
                done += _repair_partition(folder, name, mode, partition)
        manifest.problems.clear()
        recovery.count_all(folder, manifest)  # a damaged partition kept later ones from it
        done += recovery.repair(folder, manifest)
        if done:
            _store(folder, manifest)
    return done


def rebuild(folder: Path) -> None:
    """Make the manifest from the partition files alone: see `Dataset.rebuild`."""
    with _locked(folder):
        manifest = recovery.load_from_files(folder)
        recovery.repair(folder, manifest)
        _keep_old(folder)
        _store(folder, manifest)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    with files.storing(f"The repaired dataset in {folder}"):
        lock = files.lock(folder)
        try:
            yield
        finally:
            os.close(lock)


def _store(folder: Path, manifest: Manifest) -> None:
    reader = Reader(folder, manifest)
    for name in manifest.modes:
        coverage.statistics_of(reader, name)
    write_index(folder, next(reversed(manifest.sessions), "run"), manifest)
    manifest_file.save(folder, manifest)


def _sound_manifest(folder: Path) -> tuple[Manifest, list[str]]:
    """Return the manifest, or make it from the files, setting aside those that are damaged."""
    path = folder / manifest_file.FILE
    if not path.exists():
        what = f"{path} was missing: it is made anew from the partition files, without the info."
    else:
        try:
            return recovery.load(folder), []
        except DatasetError as error:
            what = str(error)
        with contextlib.suppress(DatasetError):
            manifest = recovery.load(folder, edited=True)
            if not manifest.problems and not find_problems(folder, manifest):
                for mode in manifest.modes.values():
                    mode.forget_statistics()
                return manifest, [f"{path} was edited by hand; it fits the files and is kept."]
    done = [what] + [
        _set_aside(folder, [damaged], str(error))
        for damaged, error in recovery.damaged_files(folder)
    ]
    manifest = recovery.load_from_files(folder)
    if path.exists():
        done.append(f"The old manifest is kept as {_keep_old(folder).name}.")
    return manifest, done


def _keep_old(folder: Path) -> Path:
    """Move the manifest out of the way; return where it is."""
    path = folder / manifest_file.FILE
    return path.rename(_free(path)) if path.exists() else path


def _free(path: Path) -> Path:
    """Return a name that no file has: the given one, or with a number behind it."""
    found, number = path, 0
    while found.exists():
        number += 1
        found = path.with_name(f"{path.name}.{number}")
    return found


def _repair_partition(folder: Path, name: str, mode: Mode, partition: Partition) -> list[str]:
    """Give damaged files of a partition a new header, or else set all its files aside."""
    done = []
    for field in mode.fields.values():
        problem = problem_of(folder, name, partition, field)
        if problem is None:
            continue
        path = folder / partition.file_name(name, field.name)
        if not _has_sound_rows(path, partition, field):
            mode.partitions.remove(partition)
            mode.forget_statistics()
            paths = [folder / partition.file_name(name, each) for each in mode.fields]
            return [_set_aside(folder, paths, problem, partition.rows)]
        offset = partition.offsets[field.name]
        identity = partition.identity(name, field)
        partition.offsets[field.name] = rewrite(path, identity, partition.rows, offset)
        done.append(f"{problem} Its rows are sound and have a new header.")
    return done


def _has_sound_rows(path: Path, partition: Partition, field: Field) -> bool:
    if not partition.sealed or field.name not in partition.checksums:
        return False
    rows = Segment(path, 0, partition.rows, partition.offsets[field.name], certain=True)
    try:
        return checksum(rows, field.nbytes) == partition.checksums[field.name]
    except DatasetError:
        return False


def _set_aside(folder: Path, paths: list[Path], problem: str, rows: int = 0) -> str:
    (folder / ASIDE).mkdir(exist_ok=True)
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            path.rename(_free(folder / ASIDE / path.name))
    what = f"{rows} rows" if rows else "What is left of it"
    return f"{problem} {what} of the partition cannot be used and lie in {folder / ASIDE} now."
