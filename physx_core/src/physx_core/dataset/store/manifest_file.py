"""The file ``dataset.json``: written whole, and read with distrust.

Its last entry is a CRC-32 of all that comes before it, so that a file that was cut or edited by
hand is noticed before a wrong offset gives wrong numbers. Every value is checked: a dataset may
come from a stranger.
"""

from __future__ import annotations

import json
import re
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from physx_core import files
from physx_core.dataset.store import manifest_parsing as parsing
from physx_core.dataset.store.checksums import crc32
from physx_core.dataset.store.manifest import Manifest
from physx_core.errors import ConfigError, DatasetError

FILE = "dataset.json"
FORMAT = "physx dataset"
VERSION = 1
READABLE: Mapping[int, Callable[[Mapping[str, Any]], Manifest]] = {1: parsing.manifest_of}
"""What makes the manifest of each version of the format that this physx reads."""

_LARGEST = 2**28
_END = re.compile(rb',\n "crc32": "([0-9a-f]{8})"\n\}\s*$')
_END_NBYTES = 64


def save(directory: Path, manifest: Manifest) -> None:
    """Write the manifest; a reader finds the old or the new file, whole.

    Raises:
        OSError: It cannot be written; the old one is still there.
    """
    plain = {
        "format": FORMAT,
        "format_version": VERSION,
        "versions": manifest.versions,
        "info": manifest.info,
        "modes": {name: mode.to_dict() for name, mode in manifest.modes.items()},
    }
    body = _text(plain).encode()[:-2]
    end = f',\n "crc32": "{crc32(body):08x}"\n}}'.encode()
    files.replace(directory / FILE, body + end)


def load(directory: Path, *, edited: bool = False) -> Manifest:
    """Read the manifest.

    Args:
        directory: The dataset's folder.
        edited: Whether to take it though its checksum is missing or wrong.

    Raises:
        FileNotFoundError: There is none.
        DatasetError: It is not the manifest of a dataset, or of a newer version.
    """
    path = directory / FILE
    try:
        content = files.content(path, _LARGEST)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}.") from error
    try:
        plain = json.loads(content)
        if not isinstance(plain, dict) or plain.get("format") != FORMAT:
            raise ValueError("it does not say that it is one")
        read = READABLE.get(parsing.whole(plain["format_version"], "the format's version"))
        if read is None:
            raise _newer(path, plain["format_version"])
        if not edited and not _is_whole(content):
            raise ValueError("it was cut or edited by hand: its checksum does not fit")
        return read(plain)
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        OverflowError,
        RecursionError,
        MemoryError,
        ConfigError,
    ) as error:
        reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise DatasetError(
            f"{path} ({len(content)} bytes) is not the manifest of a dataset: {reason}. "
            "`physx verify --repair` or Dataset.repair(directory) puts it right, from the "
            "partition files if need be; no row is lost."
        ) from error


def _text(plain: Mapping[str, Any]) -> str:
    """Return data as indented JSON with lists of numbers in one line, for people and for speed."""
    mark = f"numbers {uuid.uuid4().hex} "
    lines: list[str] = []

    def shortened(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: shortened(item) for name, item in value.items()}
        if not isinstance(value, list):
            return value
        first: Any = value
        while isinstance(first, list) and first:
            first = first[0]
        if isinstance(first, (int, float)) and not isinstance(first, bool):
            lines.append(json.dumps(value))
            return f"{mark}{len(lines) - 1}"
        return [shortened(item) for item in value]

    text = json.dumps(shortened(plain), indent=1)
    return re.sub(f'"{mark}([0-9]+)"', lambda found: lines[int(found[1])], text)


def _is_whole(content: bytes) -> bool:
    end = _END.search(content, max(0, len(content) - _END_NBYTES))
    return end is not None and int(end[1], 16) == crc32(content[: end.start()])


def _newer(path: Path, version: int) -> DatasetError:
    return DatasetError(
        f"{path} has version {version} of the dataset's format; this physx reads "
        f"{', '.join(map(str, READABLE))}. Update it: pip install --upgrade physx-core."
    )
