"""Opens datasets, even if the last writer was killed: no committed row is lost."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path

from physx_core import files
from physx_core.dataset.repair.quarantine import FOLDER, keep, set_aside
from physx_core.dataset.repair.salvage import seal_without_damage
from physx_core.dataset.store import changes_file, manifest_file
from physx_core.dataset.store.definitions import compare_fields
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition.commits import (
    SECTOR,
    Range,
    merge_ranges,
    name_rows,
    within,
)
from physx_core.dataset.store.partition.format import (
    FORMAT,
    MAGIC,
    SIGNATURE,
    Inspection,
    inspect,
    open_partition,
)
from physx_core.dataset.store.sealing import (
    count_rows as count_rows_of,
)
from physx_core.dataset.store.sealing import (
    measure,
    read_ends,
    remove_files,
    scan,
    seal,
    sync_files,
)
from physx_core.errors import (
    DatasetError,
    DatasetNotFoundError,
    FieldsMismatchError,
    found_at,
)
from physx_core.fields import ENDS, Field, ends_fields

_ATTEMPTS = 20
_NAME = re.compile(r".+_\w+_\w+_\d+\.h5")

Group = dict[str, Inspection]


def locate(directory: str | Path) -> Path:
    """Return the folder of a dataset, given that folder or the session's folder."""
    given = Path(directory)
    for folder in (given, given / "dataset"):
        if holds_dataset(folder):
            return folder
    raise DatasetNotFoundError(f"There is no dataset in {given}. {found_at(given)}")


def holds_dataset(folder: Path) -> bool:
    """Return whether a folder holds a manifest or partition files."""
    if (folder / manifest_file.FILE).is_file():
        return True
    return folder.is_dir() and any(_is_partition(path) for path in folder.glob("*.h5"))


def load(directory: Path, *, edited: bool = False) -> Manifest:
    """Read the manifest, or rebuild it from the partition files, and count the committed rows.

    Nothing on disk is changed. Modes whose rows cannot be counted are recorded as problems.

    Args:
        directory: The dataset's folder.
        edited: Whether to accept a manifest that was edited by hand.
    """
    for _ in range(_ATTEMPTS):
        before = _state(directory)
        try:
            manifest = manifest_file.load(directory, edited=edited)
        except FileNotFoundError:
            manifest = load_from_files(directory)
        else:
            _adopt(directory, manifest, strict=False)
            count_rows(directory, manifest)
        if _state(directory) == before:  # otherwise a writer has just replaced it
            break
    for text in _lost_rows(directory, manifest):
        warnings.warn(text, stacklevel=3)
    return manifest


def load_from_files(directory: Path) -> Manifest:
    """Build a manifest from the partition files alone; nothing on disk is changed."""
    manifest = Manifest()
    _adopt(directory, manifest, strict=True)
    count_rows(directory, manifest)
    return manifest


def damaged_files(directory: Path) -> Iterator[tuple[Path, DatasetError]]:
    """Yield each partition file that cannot be opened, with the error."""
    for path in (directory / n for n in files.names(directory) if _NAME.fullmatch(n)):
        try:
            inspect(path)
        except DatasetError as error:
            if not _is_foreign(path):
                yield path, error


def recover(directory: Path, manifest: Manifest) -> list[str]:
    """Seal partitions that a killed writer left open and remove what it left unfinished.

    Returns:
        One message for each thing that was sealed, completed or removed from the manifest.
    """
    told = _lost_rows(directory, manifest)
    count_rows(directory, manifest, thorough=True)
    for text in _lost_rows(directory, manifest):
        if text not in told:
            warnings.warn(text, stacklevel=4)
    if manifest.problems:
        raise next(iter(manifest.problems.values()))
    done = []
    for draft in chain(directory.glob("*.h5.tmp"), directory.glob(manifest_file.FILE + ".tmp")):
        files.remove(draft)
    for mode in manifest.modes.values():
        for partition in [each for each in mode.partitions if not each.sealed]:
            done.append(_close(directory, manifest, mode, partition))
    if complete_checksums(directory, manifest):
        done.append("Rows were being updated in place: their checksums have been recomputed.")
    if any(mode.dropped for mode in manifest.modes.values()):
        manifest_file.save(directory, manifest)  # nothing refers to the files any more
        clear_dropped(directory, manifest)
        done = done or ["Leftover files of removed partitions have been deleted."]
    return done + _clear_unlisted(directory, manifest)


def _lost_rows(directory: Path, manifest: Manifest) -> list[str]:
    """Return one message for each open partition with unusable rows."""
    partitions = chain.from_iterable(mode.partitions for mode in manifest.modes.values())
    return [f"{directory}: {_label(p)}: {p.problem}" for p in partitions if p.problem]


def _label(partition: Partition) -> str:
    return (
        f"Partition {partition.index} of session {partition.session!r} and mode {partition.mode!r}"
    )


def _close(directory: Path, manifest: Manifest, mode: Mode, partition: Partition) -> str:
    """Seal an open partition whose writer is gone, or remove it; return what was done."""
    without = " without its damaged ones" if partition.damaged else ""
    what = f"of {partition.rows} rows was left open and has been sealed{without}."
    if not partition.rows:
        what = "had no committed rows and has been removed."
    if partition.problem:  # the original files are kept
        keep(directory, [partition.path(directory, name) for name in mode.files])
        what += f" {partition.problem} The original files are in {directory / FOLDER}."
    if not partition.rows:
        mode.partitions.remove(partition)
        mode.dropped.append(partition)
    elif partition.damaged:
        seal_without_damage(directory, manifest, mode, partition)
    else:
        listed = bool(partition.offsets)  # other files may be sealed, as an older manifest says
        mode.swap(seal(directory, mode.files, partition, rewrite=listed))
    return f"{_label(partition)} {what}"


def clear_dropped(directory: Path, manifest: Manifest) -> None:
    """Remove leftover files of removed partitions."""
    for mode in manifest.modes.values():
        for partition in mode.dropped:
            remove_files(directory, mode.files, partition)
        mode.dropped.clear()


def _clear_unlisted(directory: Path, manifest: Manifest) -> list[str]:
    """Remove unlisted partitions without rows; set torn files aside."""
    done = []
    groups: dict[tuple[str, str, int], dict[Path, Inspection]] = {}
    for path in _unlisted(directory, manifest):
        try:
            found = inspect(path)
        except DatasetError as error:
            if _is_torn(path):
                done.append(f"{error} It was moved to {set_aside(directory, [path])}.")
        else:
            identity = found.identity
            key = identity.mode, identity.session, identity.index
            groups.setdefault(key, {})[path] = found
    unfinished = [group for group in groups.values() if not _has_rows(group.values())]
    if unfinished:
        manifest_file.save(directory, manifest)  # the one on disk may refer to the files
    for group in unfinished:
        _remove_unfinished(directory, group)
    return done


def _has_rows(group: Collection[Inspection]) -> bool:
    """Return whether all files of a partition have rows; its rows may have no entries."""
    counts = {found.identity.field.name: found.rows for found in group}
    axes = {found.identity.field.name: found.identity.field.free_axis for found in group}
    return all(rows or counts.get(axes[name] + ENDS) for name, rows in counts.items())


def _remove_unfinished(directory: Path, group: Mapping[Path, Inspection]) -> None:
    """Remove the files of a partition if some of them have no rows.

    Files with rows go first: left alone, they would look like a complete partition with fewer
    fields.
    """
    with_rows = [path for path, found in group.items() if found.rows]
    for path in with_rows:
        files.remove(path)
    if with_rows:
        files.sync_folder(directory)
    for path in group:
        files.remove(path)


def complete_checksums(directory: Path, manifest: Manifest) -> bool:
    """Recompute checksums that in-place updates have invalidated; return whether there were any."""
    changed = False
    for mode in manifest.modes.values():
        for partition in [p for p in mode.partitions if p.sealed and not p.checksums]:
            changed = True
            sync_files(directory, mode.files, partition)
            mode.swap(scan(directory, mode.files, partition))
    return changed


def count_rows(directory: Path, manifest: Manifest, *, thorough: bool = False) -> None:
    """Count the committed rows; modes whose rows cannot be counted are recorded as problems.

    Args:
        directory: The dataset's folder.
        manifest: The manifest; receives the counts.
        thorough: Whether to compare the rows of all open partitions with their digests, not only
            those that were written before the machine's last boot.
    """
    for name, mode in manifest.modes.items():
        try:
            for partition in mode.partitions:
                if not partition.sealed:
                    _count_open(directory, mode, partition, thorough)
            _discard_behind_gaps(mode)
        except DatasetError as error:
            manifest.problems[name] = error


def _count_open(directory: Path, mode: Mode, partition: Partition, thorough: bool) -> None:
    """Count the rows of an open partition that can be read in all its files.

    The files' headers reach the disk before the manifest lists the files, hence before any row is
    committed. A partition without rows in any file is therefore no error, whatever it lacks.
    """
    counted, rows, losses, unreadable = {}, {}, [], None
    damaged: dict[str, tuple[Range, ...]] = {}
    for name, field in mode.files.items():
        path = partition.path(directory, name)
        try:
            found, kept = partition.find_rows(directory, field, thorough=thorough)
        except DatasetError as error:
            unreadable = error
            continue
        have = found.identity.field
        if have != field and field.shape is not None:
            raise DatasetError(f"{path} holds {have}, but the dataset says {field}.")
        if kept is None:
            raise DatasetError(
                f"{path} was changed or is damaged: its rows do not match their recorded "
                "checksums. Restore it from a backup, or set it aside with `physx verify --repair`."
            )
        counted[name] = found.rows if found.is_consistent else kept.commit.rows
        rows[name] = kept.commit.rows
        damaged[name] = kept.damaged
        partition.kept[name] = kept
        if not found.is_consistent:
            losses.append(
                f"The row count in {path.name} is damaged; {kept.commit.rows} rows match."
            )
    if unreadable is not None and any(counted.values()):
        raise unreadable
    partition.rows = 0 if unreadable is not None else min(rows.values())
    most = 0 if unreadable is not None else min(counted.values())
    ranges = [each for name in damaged for each in damaged[name]]
    if mode.ends and unreadable is None:
        most, ranges = _count_entries(directory, mode, partition, counted, rows, damaged)
    if missing := most - partition.rows:
        losses.append(f"Its last {missing} rows did not reach the disk.")
    partition.damaged = tuple(within(merge_ranges(ranges), partition.rows))
    if partition.damaged:
        what = name_rows(partition.damaged).capitalize()
        losses.append(f"{what} are damaged: their bits have changed since they were stored.")
    partition.problem = str(unreadable) if unreadable is not None else " ".join(losses)


def _count_entries(
    directory: Path,
    mode: Mode,
    partition: Partition,
    counted: Mapping[str, int],
    rows: Mapping[str, int],
    damaged: Mapping[str, Sequence[Range]],
) -> tuple[int, list[Range]]:
    """Count the rows of a partition whose entries are there as well.

    Args:
        directory: The dataset's folder.
        mode: The mode.
        partition: The partition; receives rows and sizes.
        counted: How many rows, or entries, each file counts, by field.
        rows: How many of these can be read.
        damaged: Which of these are damaged.

    Returns:
        How many rows the files count, and which of them are damaged. If the end of a row is, so are
        all rows from there on.
    """
    files_of, found = mode.files, list[Range]()
    most = min(n for name, n in rows.items() if not files_of[name].free_axis)
    for name in mode.ends:
        most = min([most, *(start for start, _ in damaged[name])])
        found += [(start, most) for start, _ in damaged[name]]
    sound = {n: c if files_of[n].free_axis else min(c, most) for n, c in rows.items()}
    count_rows_of(directory, files_of, partition, sound)
    kept = partition.rows
    for name, ranges in damaged.items():
        field = files_of[name]
        if not field.free_axis:
            found += [] if name in mode.ends else ranges
            continue
        ends = read_ends(directory, files_of[field.free_axis + ENDS], partition)
        for start, stop in ranges:
            first, last = ends.searchsorted([start, stop - 1], "right").tolist()
            found.append((first, last + 1))
    partition.sizes = measure(directory, files_of, partition).sizes
    lost = any(rows[name] < counted[name] or damaged[name] for name in rows)
    fixed = [count for name, count in counted.items() if not files_of[name].free_axis]
    return min(fixed) if lost or min(fixed) > most else kept, found


def _discard_behind_gaps(mode: Mode) -> None:
    """Discard rows of open partitions that would come after a gap.

    These are the rows of partitions whose writer had filled an earlier one, if that one has lost
    rows or never got them.
    """
    for partition in mode.partitions:
        if not partition.sealed and partition.rows and _follows_gap(mode, partition):
            partition.problem = "It comes after rows that did not reach the disk."
            partition.rows = 0


def _follows_gap(mode: Mode, partition: Partition) -> bool:
    if partition.follows is None:
        return False
    index, rows = partition.follows
    key = partition.session, index
    return any(p.key == key and p.rows < rows for p in mode.partitions)


def _is_partition(path: Path) -> bool:
    """Return whether a file claims to be a partition, judging by its first bytes."""
    try:
        with open_partition(path) as file:
            head = file.read(2**14) or b""
            return MAGIC in head or FORMAT.encode() in head
    except DatasetError:  # a link, a pipe, or no permission to read it
        return False


def _state(directory: Path) -> list[tuple[int, int, int] | None]:
    """Return a value that changes whenever the manifest or what continues it does."""
    found: list[tuple[int, int, int] | None] = []
    for name in (manifest_file.FILE, changes_file.FILE):
        try:
            now = (directory / name).stat()
        except OSError:
            found.append(None)
        else:
            found.append((now.st_ino, now.st_mtime_ns, now.st_size))
    return found


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
        identity = next(iter(group.values())).identity
        if not _has_rows(group.values()):
            continue  # the writer was killed before the partition's first commit
        fields = {name: found.identity.field for name, found in sorted(group.items(), key=_role)}
        for name in ends_fields(fields.values()):
            fields.pop(name, None)
        mode = manifest.modes.get(mode_name)
        if mode is not None and not strict and not _fits(mode, fields):
            continue  # part of a partition that was being removed, or of another dataset
        mode = manifest.modes.setdefault(mode_name, Mode(fields))
        mode.add(Partition(mode_name, session, index, identity.first_row))
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


def _order(item: tuple[tuple[str, str, int], Group]) -> tuple[str, int, str, int]:
    (mode, session, index), group = item
    return mode, min(found.identity.first_row for found in group.values()), session, index


def _role(item: tuple[str, Inspection]) -> tuple[bool, str]:
    name, found = item
    return found.identity.field.role != "training", name


def _unlisted(directory: Path, manifest: Manifest) -> list[Path]:
    known = manifest.file_names | {f"{session}.h5" for session in manifest.sessions}
    return [
        directory / name
        for name in files.names(directory)
        if name.endswith(".h5") and name not in known and _NAME.fullmatch(name)
    ]


def _is_torn(path: Path) -> bool:
    """Return whether a file may be the remains of an unlisted partition after a power failure."""
    try:
        open_partition(path).close()
    except DatasetError:  # a link, a pipe, or no permission to read it
        return False
    return not _is_foreign(path)


def _is_foreign(path: Path) -> bool:
    """Return whether a file is not a partition, by its name or as HDF5 of another kind."""
    if not _NAME.fullmatch(path.name):
        return True
    try:
        with open_partition(path) as file:
            head = file.read(2**14) or b""
    except DatasetError:
        return False
    if not head.startswith(SIGNATURE) or not any(head[SECTOR:]):
        return False
    return MAGIC not in head and FORMAT.encode() not in head
