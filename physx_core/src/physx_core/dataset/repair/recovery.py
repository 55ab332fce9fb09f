"""Opening a dataset whatever happened to its last writer: no committed row is lost."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path

from physx_core.dataset.store import manifest_file
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition_format import (
    FORMAT,
    UNREADABLE,
    Inspection,
    inspect,
    open_partition,
)
from physx_core.dataset.store.sealing import remove_files, scanned, seal, sync_files
from physx_core.dataset.write.definitions import compare_fields
from physx_core.errors import DatasetError, DatasetNotFoundError, FieldsMismatchError, listed
from physx_core.fields import Field

_ATTEMPTS = 20
_NAME = re.compile(r".+_\w+_\w+_\d+\.h5")

Group = dict[str, Inspection]


def locate(directory: str | Path) -> Path:
    """Return the folder of a dataset, given that folder or the session's folder around it.

    Raises:
        DatasetNotFoundError: There is no dataset; the message says what there is.
    """
    given = Path(directory)
    for folder in (given, given / "dataset"):
        if holds_dataset(folder):
            return folder
    if not given.is_dir():
        parent = given.absolute().parent
        around = [p.name for p in parent.iterdir()] if parent.is_dir() else []
        what = f"The folder does not exist. In {parent} there is: {listed(around)}."
    else:
        what = f"The folder holds: {listed(p.name for p in given.iterdir())}."
    raise DatasetNotFoundError(f"There is no dataset in {given}. {what}")


def holds_dataset(folder: Path) -> bool:
    """Return whether a folder holds a manifest or partition files."""
    if (folder / manifest_file.FILE).is_file():
        return True
    return folder.is_dir() and any(is_partition(path) for path in folder.glob("*.h5"))


def load(directory: Path, *, edited: bool = False) -> Manifest:
    """Read the manifest, or rebuild it from the partition files, and count what is committed.

    Nothing on the disk is changed. Modes whose rows cannot be counted are noted as problems.

    Args:
        directory: The dataset's folder.
        edited: Whether to take a manifest that was edited by hand.

    Raises:
        DatasetError: The manifest is not valid, or is missing and a partition is damaged.
    """
    for _ in range(_ATTEMPTS):
        before = _state(directory)
        manifest = _load(directory, edited)
        if _state(directory) == before:  # otherwise a writer has replaced it meanwhile
            break
    return manifest


def load_from_files(directory: Path) -> Manifest:
    """Make a manifest of the partition files alone; nothing on the disk is changed.

    Raises:
        DatasetError: A partition is damaged.
    """
    manifest = Manifest()
    _adopt(directory, manifest, strict=True)
    count_all(directory, manifest)
    return manifest


def damaged_files(directory: Path) -> Iterator[tuple[Path, DatasetError]]:
    """Yield the partition files that cannot be opened, and why."""
    for path in sorted(directory.glob("*.h5")):
        try:
            inspect(path)
        except DatasetError as error:
            if not _is_foreign(path):
                yield path, error


def refresh(directory: Path, manifest: Manifest) -> bool:
    """See what other processes have committed; return whether rows known before have moved.

    Raises:
        DatasetError: The manifest is not valid any more.
    """
    return manifest.take(load(directory))


def repair(directory: Path, manifest: Manifest) -> list[str]:
    """Seal what a killed writer left open and remove what it left half made.

    Returns:
        What was sealed, completed or removed from the manifest, as texts.

    Raises:
        DatasetError: A partition is missing or damaged.
        OSError: A partition cannot be rewritten; nothing is lost.
    """
    if manifest.problems:
        raise next(iter(manifest.problems.values()))
    done = []
    for draft in chain(directory.glob("*.h5.tmp"), directory.glob(manifest_file.FILE + ".tmp")):
        draft.unlink()
    for name, mode in manifest.modes.items():
        for partition in [p for p in mode.partitions if not p.sealed]:
            if partition.rows:
                mode.swap(seal(directory, name, mode.fields, partition))
                what = f"of {partition.rows} rows was left open and is sealed now."
            else:
                mode.partitions.remove(partition)
                mode.dropped.append(partition)
                what = "had no committed row and is removed."
            done.append(f"{_label(name, partition)} {what}")
    if complete_checksums(directory, manifest):
        done.append("Rows were being updated in place: their checksums are computed anew.")
    if any(mode.dropped for mode in manifest.modes.values()):
        manifest_file.save(directory, manifest)  # now nothing refers to the files any more
        clear_dropped(directory, manifest)
        done = done or ["What was left of removed partitions is gone now."]
    for path in _unlisted(directory, manifest):
        if is_partition(path) and not inspect(path).rows:
            path.unlink()
    return done


def clear_dropped(directory: Path, manifest: Manifest) -> None:
    """Remove the files of dropped partitions, and forget them.

    Raises:
        OSError: A file cannot be removed.
    """
    for name, mode in manifest.modes.items():
        for partition in mode.dropped:
            remove_files(directory, name, mode, partition)
        mode.dropped.clear()


def complete_checksums(directory: Path, manifest: Manifest) -> bool:
    """Compute the checksums that updates in place have made void; return whether there were any.

    Raises:
        DatasetError: A partition is missing or damaged.
        OSError: The rows cannot be brought to the disk.
    """
    changed = False
    for name, mode in manifest.modes.items():
        for partition in [p for p in mode.partitions if p.sealed and not p.checksums]:
            changed = True
            sync_files(directory, name, mode, partition)
            found = scanned(directory, name, mode.fields, partition)
            if partition.counted:
                found = replace(found, counted=True, running={})
            mode.swap(found)
    return changed


def is_partition(path: Path) -> bool:
    """Return whether a file calls itself a partition, as far as its first bytes tell."""
    try:
        with open_partition(path) as file:
            return FORMAT.encode() in (file.read(2**14) or b"")
    except DatasetError:  # a link, a pipe, or no right to read it
        return False


def _load(directory: Path, edited: bool) -> Manifest:
    try:
        manifest = manifest_file.load(directory, edited=edited)
    except FileNotFoundError:
        return load_from_files(directory)
    _adopt(directory, manifest, strict=False)
    count_all(directory, manifest)
    return manifest


def _state(directory: Path) -> tuple[int, int] | None:
    """Return what changes whenever the manifest is replaced."""
    try:
        now = (directory / manifest_file.FILE).stat()
    except OSError:
        return None
    return now.st_ino, now.st_mtime_ns


def count_all(directory: Path, manifest: Manifest) -> None:
    """Count what is committed; modes whose rows cannot be counted are noted as problems."""
    for name, mode in manifest.modes.items():
        try:
            _count(directory, name, mode)
        except DatasetError as error:
            manifest.problems[name] = error


def _count(directory: Path, mode_name: str, mode: Mode) -> None:
    """Ask the files of unsealed partitions for their rows."""
    for partition in mode.partitions:
        if partition.sealed:
            continue
        found = {
            name: inspect(
                directory / partition.file_name(mode_name, name),
                partition.offsets.get(name),
                field.nbytes,
            )
            for name, field in mode.fields.items()
        }
        for name, field in mode.fields.items():
            if found[name].identity.field != field and field.shape is not None:
                path = directory / partition.file_name(mode_name, name)
                have = found[name].identity.field
                raise DatasetError(f"{path} holds {have}, but the dataset says {field}.")
        partition.rows = min(inspection.rows for inspection in found.values())


def _adopt(directory: Path, manifest: Manifest, strict: bool) -> None:
    """Add partitions with committed rows that the manifest does not list."""
    groups: dict[tuple[str, str, int], Group] = {}
    for path in _unlisted(directory, manifest):
        try:
            found = inspect(path)
        except DatasetError:
            if strict and not _is_foreign(path):
                raise
            continue
        identity = found.identity
        if path.name == identity.file_name:
            key = identity.mode, identity.session, identity.index
            groups.setdefault(key, {})[identity.field.name] = found
    for (mode_name, session, index), group in sorted(groups.items(), key=_order):
        if not all(found.rows for found in group.values()):
            continue  # the writer was killed before the partition's first commit
        fields = {name: found.identity.field for name, found in sorted(group.items(), key=_role)}
        mode = manifest.modes.get(mode_name)
        if mode is not None and not strict and not _fits(mode, fields):
            continue  # a part of what was being removed, or nothing of this dataset
        mode = manifest.modes.setdefault(mode_name, Mode(fields))
        first_row = next(iter(group.values())).identity.first_row
        mode.partitions.append(Partition(session, index, first_row))
        mode.fields |= {
            name: field
            for name, field in fields.items()
            if name not in mode.fields or mode.fields[name].shape is None
        }


def _fits(mode: Mode, fields: Mapping[str, Field]) -> bool:
    try:
        compare_fields("", mode.fields, fields)
    except FieldsMismatchError:
        return False
    return True


def _label(mode_name: str, partition: Partition) -> str:
    return f"Partition {partition.index} of session {partition.session!r} and mode {mode_name!r}"


def _order(item: tuple[tuple[str, str, int], Group]) -> tuple[str, int, str, int]:
    (mode, session, index), group = item
    return mode, min(found.identity.first_row for found in group.values()), session, index


def _role(item: tuple[str, Inspection]) -> tuple[bool, str]:
    name, found = item
    return found.identity.field.role != "training", name


def _unlisted(directory: Path, manifest: Manifest) -> list[Path]:
    known = manifest.file_names | {f"{session}.h5" for session in manifest.sessions}
    return [path for path in sorted(directory.glob("*.h5")) if path.name not in known]


def _is_foreign(path: Path) -> bool:
    """Return whether a file is no partition: by its name, or because it is other, sound HDF5."""
    import h5py

    if not _NAME.fullmatch(path.name):
        return True
    try:
        with open_partition(path) as raw, h5py.File(raw, "r") as file:
            return bool(file.attrs.get("format") != FORMAT)
    except (DatasetError, *UNREADABLE):
        return False
