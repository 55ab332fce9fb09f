"""Opening a dataset whatever happened to its last writer: no committed row is lost."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

from physx_core.dataset import manifest as manifests
from physx_core.dataset.layout import FORMAT, Inspection, inspect
from physx_core.dataset.manifest import Manifest, Mode, Partition
from physx_core.dataset.sealing import remove_files, seal
from physx_core.errors import DatasetError, DatasetNotFoundError, listed

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
    if (folder / manifests.FILE).is_file():
        return True
    return folder.is_dir() and any(_is_partition(path) for path in folder.glob("*.h5"))


def load(directory: Path) -> Manifest:
    """Read the manifest, or rebuild it from the partition files, and count what is committed.

    Nothing on the disk is changed. Modes whose rows cannot be counted are noted as problems.

    Raises:
        DatasetError: The manifest is not valid, or is missing and a partition is damaged.
    """
    try:
        manifest = Manifest.load(directory)
        strict = False
    except FileNotFoundError:
        manifest, strict = Manifest(), True
    _adopt(directory, manifest, strict)
    for name, mode in manifest.modes.items():
        try:
            _count(directory, name, mode)
        except DatasetError as error:
            manifest.problems[name] = error
    return manifest


def repair(directory: Path, manifest: Manifest) -> bool:
    """Seal what a killed writer left open and remove what it left half made.

    Returns:
        Whether anything was sealed or removed from the manifest.

    Raises:
        DatasetError: A partition is missing or damaged.
        OSError: A partition cannot be rewritten; nothing is lost.
    """
    changed = False
    if manifest.problems:
        raise next(iter(manifest.problems.values()))
    for draft in chain(directory.glob("*.h5.tmp"), directory.glob(manifests.FILE + ".tmp")):
        draft.unlink()
    for name, mode in manifest.modes.items():
        for partition in [p for p in mode.partitions if not p.sealed]:
            changed = True
            if partition.rows:
                seal(directory, name, mode, partition)
            else:
                mode.partitions.remove(partition)
                remove_files(directory, name, mode, partition)
    for path in _unlisted(directory, manifest):
        if _is_partition(path) and not inspect(path).rows:
            path.unlink()
    return changed


def _count(directory: Path, mode_name: str, mode: Mode) -> None:
    """Ask the files of unsealed partitions for their rows, and number the partitions' rows."""
    first_row = 0
    for partition in mode.partitions:
        if not partition.sealed:
            partition.rows = min(
                inspect(
                    directory / partition.file_name(mode_name, name),
                    partition.offsets.get(name),
                    field.nbytes,
                ).rows
                for name, field in mode.fields.items()
            )
        partition.first_row = first_row
        first_row += partition.rows


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
        mode = manifest.modes.setdefault(mode_name, Mode(fields))
        first_row = next(iter(group.values())).identity.first_row
        mode.partitions.append(Partition(session, index, first_row))
        mode.fields |= {
            name: field
            for name, field in fields.items()
            if name not in mode.fields or mode.fields[name].shape is None
        }


def _order(item: tuple[tuple[str, str, int], Group]) -> tuple[str, int, str, int]:
    (mode, session, index), group = item
    return mode, min(found.identity.first_row for found in group.values()), session, index


def _role(item: tuple[str, Inspection]) -> tuple[bool, str]:
    name, found = item
    return found.identity.field.role != "training", name


def _unlisted(directory: Path, manifest: Manifest) -> list[Path]:
    known = manifest.file_names | {f"{session}.h5" for session in manifest.sessions}
    return [path for path in sorted(directory.glob("*.h5")) if path.name not in known]


def _is_partition(path: Path) -> bool:
    """Return whether a file calls itself a partition, as far as its first bytes tell."""
    with path.open("rb") as file:
        return FORMAT.encode() in file.read(2**14)


def _is_foreign(path: Path) -> bool:
    """Return whether a file is sound HDF5, but no partition."""
    import h5py

    try:
        with path.open("rb") as raw, h5py.File(raw, "r") as file:
            return bool(file.attrs.get("format") != FORMAT)
    except (OSError, RuntimeError):
        return False
