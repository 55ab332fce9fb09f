"""Writes and reads the file ``dataset.json``, and the changes since it was written.

Its size does not depend on the fields' shapes: statistics, which do, have a file of their own. Nor
is it written for each new partition: see `physx_core.dataset.store.changes_file`. Its last entry is
a CRC-32 of everything before it, so that truncation or manual edits are noticed before a wrong
offset yields wrong numbers. Every value is validated: a dataset may come from an untrusted source.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.dataset.store import changes_file, statistics_file
from physx_core.dataset.store.changes_file import End
from physx_core.dataset.store.manifest import Manifest, Partition
from physx_core.dataset.store.manifest_parsing import apply_change, parse_manifest
from physx_core.dataset.store.validation import whole
from physx_core.errors import ConfigError, DatasetError
from physx_core.origin import install_hint
from physx_core.parsing import parse_json

FILE = "dataset.json"
FORMAT = "physx dataset"
VERSION = 1

_LARGEST = 2**27
_END = re.compile(rb',\n "crc32": "([0-9a-f]{8})"\n\}\s*$')
_END_NBYTES = 64
_INVALID = (
    ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError, MemoryError,
    ConfigError,
)  # fmt: skip
"""Errors that reading and parsing raise for text that is not a manifest."""


def save(directory: Path, manifest: Manifest) -> None:
    """Write the manifest atomically, after the statistics if they are not stored yet.

    It takes over all changes.
    """
    before, after = manifest.statistics_checksum, _store_statistics(directory, manifest)
    plain = {
        "format": FORMAT,
        "format_version": VERSION,
        "versions": manifest.versions,
        "info": manifest.info,
        "modes": {name: mode.to_dict() for name, mode in manifest.modes.items()},
    }
    if after is not None:
        plain["statistics"] = statistics_file.reference(after)
    body = _format(plain).encode()[:-2]
    checksum = crc32(body)
    content = body + f',\n "crc32": "{checksum:08x}"\n}}'.encode()
    files.replace(directory / FILE, content)
    manifest.statistics_checksum = after
    manifest.end = End.of_manifest(checksum, len(content), manifest.statistics_checksum)
    changes_file.remove(directory)
    if before is None and after is not None:
        statistics_file.clear(directory, after)


def append(directory: Path, manifest: Manifest, end: End, partitions: list[Partition]) -> None:
    """List partitions that were begun or sealed, without writing the whole manifest.

    Args:
        directory: The dataset's folder.
        manifest: The manifest, which receives them.
        end: Where its changes go.
        partitions: The partitions, at least one.
    """
    before, after = end.statistics, _store_statistics(directory, manifest)
    if after is None:  # a change cannot say so: the file stays, and no counted row is in it
        after = before
    plain = [{"mode": each.mode, "partition": each.to_dict()} for each in partitions]
    change: dict[str, Any] = {**plain[0], "also": plain[1:]} if plain[1:] else plain[0]
    if after is not None and after != before:
        change["statistics"] = statistics_file.reference(after)
    end = changes_file.append(directory, end, change)  # they count in the statistics, or none does
    manifest.end, manifest.statistics_checksum = end._replace(statistics=after), after
    for each in partitions:
        manifest.modes[each.mode].put(each)
    if after != before:
        statistics_file.remove(directory, before)


def _store_statistics(directory: Path, manifest: Manifest) -> int | None:
    """Store the statistics if they are not stored yet; return the checksum of their file."""
    if manifest.statistics_checksum is not None:
        return manifest.statistics_checksum
    return statistics_file.write(directory, manifest)


def read(directory: Path) -> bytes:
    """Return the content of the manifest file."""
    return files.read_content(directory / FILE, _LARGEST)


def load(directory: Path, *, edited: bool = False) -> Manifest:
    """Read the manifest and the changes since it was written.

    Args:
        directory: The dataset's folder.
        edited: Whether to accept it if its checksum is missing or wrong.
    """
    path = directory / FILE
    try:
        content = read(directory)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}.") from error
    with _parsing(path, len(content)):
        plain = parse_json(content)
        if not isinstance(plain, dict) or plain.get("format") != FORMAT:
            raise ValueError(f'its format is not "{FORMAT}"')
        version = whole(plain["format_version"], "the format's version")
        if version != VERSION:
            raise DatasetError(
                f"{path} has version {version} of the dataset's format, but this physx reads "
                f"version {VERSION}. {install_hint('physx-core', update=True)}"
            )
        if not edited and not _is_whole(content):
            raise ValueError("it was truncated or edited by hand: its checksum does not match")
        manifest = parse_manifest(plain)
    checksum = _stored_checksum(content)
    if checksum is not None:
        manifest.end = End.of_manifest(checksum, len(content), manifest.statistics_checksum)
        load_changes(directory, manifest)
    return manifest


def load_changes(directory: Path, manifest: Manifest) -> None:
    """Take over changes that have been added since the manifest was loaded."""
    path = directory / changes_file.FILE
    assert manifest.end is not None
    try:
        with _parsing(path, manifest.end.nbytes):
            for change, end in changes_file.read(directory, manifest.end):
                apply_change(manifest, change)
                manifest.end = end._replace(statistics=manifest.statistics_checksum)
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}.") from error


def is_continued(directory: Path, manifest: Manifest) -> bool:
    """Return whether the manifest on disk is still the one that this one is or continues."""
    if manifest.end is None:
        return False
    with contextlib.suppress(OSError):
        content = files.read_tail(directory / FILE, _END_NBYTES)
        return _stored_checksum(content) == manifest.end.manifest
    return False


@contextlib.contextmanager
def _parsing(path: Path, nbytes: int) -> Iterator[None]:
    """Convert errors of parsing to one that names the file."""
    try:
        yield
    except OSError:
        raise
    except _INVALID as error:
        reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise DatasetError(
            f"{path} ({nbytes} bytes) is not the manifest of a dataset: {reason}. "
            "`physx verify --repair` or Dataset.repair(directory) repairs it, from the partition "
            "files if necessary; no row is lost."
        ) from error


def was_updated(directory: Path, partition: Partition, name: str) -> bool:
    """Return whether the manifest on disk has a different checksum for a field of a partition.

    If so, the writer has updated rows; rows that do not match the old checksum are not damaged.
    """
    try:
        mode = load(directory).modes[partition.mode]
        now = mode.partitions[mode.place(partition)]
    except (DatasetError, FileNotFoundError, KeyError, ValueError):
        return False
    same = now.first_row == partition.first_row  # not a later one of the same name
    return same and now.checksums.get(name) != partition.checksums.get(name)


def _format(value: Any, indent: str = "\n") -> str:
    """Return data as indented JSON with each item of a list on one line: readable and fast."""
    inner = indent + " "
    if isinstance(value, dict) and value:
        items = (f"{json.dumps(name)}: {_format(item, inner)}" for name, item in value.items())
        return "{" + inner + f",{inner}".join(items) + indent + "}"
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return "[" + inner + f",{inner}".join(map(json.dumps, value)) + indent + "]"
    return json.dumps(value)


def _is_whole(content: bytes) -> bool:
    end = _END.search(content, max(0, len(content) - _END_NBYTES))
    return end is not None and int(end[1], 16) == crc32(content[: end.start()])


def _stored_checksum(content: bytes) -> int | None:
    """Return the checksum that the end of a manifest holds, whether or not it is right."""
    end = _END.search(content, max(0, len(content) - _END_NBYTES))
    return None if end is None else int(end[1], 16)
