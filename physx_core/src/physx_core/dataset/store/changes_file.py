"""The file ``changes.jsonl``: partitions that were begun or sealed since the manifest was written.

A new partition is one line here instead of a new manifest, whose size grows with the number of
partitions; several that are listed at once share a line, so that a cut leaves all of them or none,
as the statistics that a line names are those of all. Each line is on the disk before it is relied
upon. It ends in a CRC-32 of everything before it, the manifest included: lines that do not continue
the manifest, because they are torn or older than it, are no part of the dataset. The manifest takes
them over when they have grown to half of its size, at any other change, and when the dataset is
opened for writing or closed.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.parsing import parse_json

FILE = "changes.jsonl"

_LARGEST = 2**27
_END = re.compile(rb', "crc32": "([0-9a-f]{8})"\}\n\Z')


class End(NamedTuple):
    """Where the next change goes.

    Attributes:
        manifest: CRC-32 of the manifest that the changes continue.
        manifest_nbytes: Its size.
        crc32: That of the manifest and all changes so far.
        nbytes: Their size.
        statistics: CRC-32 of the file of statistics that they refer to; None if there is none.
    """

    manifest: int
    manifest_nbytes: int
    crc32: int
    nbytes: int
    statistics: int | None

    @classmethod
    def of_manifest(cls, checksum: int, nbytes: int, statistics: int | None) -> End:
        """Return where the first change goes."""
        return cls(checksum, nbytes, checksum, 0, statistics)

    @property
    def is_far(self) -> bool:
        """Whether it is time for the manifest to take the changes over."""
        return 2 * self.nbytes > self.manifest_nbytes


def append(directory: Path, end: End, change: Mapping[str, Any]) -> End:
    """Append a change and wait until it is on the disk; return where the next one goes."""
    body = json.dumps(change).encode()[:-1]
    crc = crc32(body, end.crc32)
    content = body + b', "crc32": "%08x"}\n' % crc
    with files.opened(directory / FILE, os.O_RDWR | os.O_CREAT) as descriptor:
        files.write_at(descriptor, content, end.nbytes)
        files.sync(descriptor)
    if not end.nbytes:
        files.sync_folder(directory)
    return end._replace(crc32=crc, nbytes=end.nbytes + len(content))


def read(directory: Path, end: End) -> Iterator[tuple[Any, End]]:
    """Yield the changes from some place on, each with the place after it.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If a line is not JSON.
    """
    try:
        content = files.read_content(directory / FILE, _LARGEST)
    except FileNotFoundError:
        return
    for line in content[end.nbytes :].splitlines(keepends=True):
        found = _END.search(line)
        if found is None or int(found[1], 16) != crc32(line[: found.start()], end.crc32):
            return
        end = end._replace(crc32=int(found[1], 16), nbytes=end.nbytes + len(line))
        yield parse_json(line), end


def remove(directory: Path) -> None:
    """Remove the file, which the manifest has taken over."""
    files.remove(directory / FILE)
