"""Writes and reads the file ``dataset.json``.

Its size does not depend on the fields' shapes: statistics, which do, have a file of their own. Its
last entry is a CRC-32 of everything before it, so that truncation or manual edits are noticed
before a wrong offset yields wrong numbers. Every value is validated: a dataset may come from an
untrusted source.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.dataset.store import statistics_file
from physx_core.dataset.store.manifest import Manifest, Partition
from physx_core.dataset.store.manifest_parsing import parse_manifest
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
    """Write the manifest atomically, after the statistics if they are not stored yet."""
    before, after = manifest.statistics_checksum, manifest.statistics_checksum
    if before is None:
        after = statistics_file.write(directory, manifest)
    plain = {
        "format": FORMAT,
        "format_version": VERSION,
        "versions": manifest.versions,
        "info": manifest.info,
        "modes": {name: mode.to_dict() for name, mode in manifest.modes.items()},
    }
    if after is not None:
        name = statistics_file.file_name(after)
        plain["statistics"] = {"file": name, "crc32": f"{after:08x}"}
    body = _format(plain).encode()[:-2]
    end = f',\n "crc32": "{crc32(body):08x}"\n}}'.encode()
    files.replace(directory / FILE, body + end)
    manifest.statistics_checksum = after
    if before is None and after is not None:
        statistics_file.clear(directory, after)


def read(directory: Path) -> bytes:
    """Return the content of the manifest file."""
    return files.read_content(directory / FILE, _LARGEST)


def load(directory: Path, *, edited: bool = False) -> Manifest:
    """Read the manifest.

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
    try:
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
        return parse_manifest(plain)
    except _INVALID as error:
        reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise DatasetError(
            f"{path} ({len(content)} bytes) is not the manifest of a dataset: {reason}. "
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
    """Return data as indented JSON with lists of numbers on one line: readable and fast."""
    inner = indent + " "
    if isinstance(value, dict) and value:
        items = (f"{json.dumps(name)}: {_format(item, inner)}" for name, item in value.items())
        return "{" + inner + f",{inner}".join(items) + indent + "}"
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        items = (_format(item, inner) for item in value)
        return "[" + inner + f",{inner}".join(items) + indent + "]"
    return json.dumps(value)


def _is_whole(content: bytes) -> bool:
    end = _END.search(content, max(0, len(content) - _END_NBYTES))
    return end is not None and int(end[1], 16) == crc32(content[: end.start()])
