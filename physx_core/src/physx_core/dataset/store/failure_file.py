"""The file with the reasons why episodes failed: one line of JSON for each, appended.

No row depends on it, and it is never needed for reading: a missing file, and a line that is torn or
of another form, only means that reasons are unknown.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from physx_core import files
from physx_core.dataset.store.validation import checked, whole
from physx_core.parsing import parse_json

FILE = "failures.jsonl"

_LARGEST = 2**28
_LONGEST = 4000


class FailedEpisode(NamedTuple):
    """Why an episode failed.

    Attributes:
        mode: Mode of its rows, had it had any.
        campaign: Number of the campaign.
        episode: Number of the episode in the campaign.
        reason: Why it failed; empty if unknown.
    """

    mode: str
    campaign: int
    episode: int
    reason: str


def append(directory: Path, failures: Iterable[FailedEpisode]) -> None:
    """Append failures to the file, which is created if needed."""
    lines = [json.dumps(f._replace(reason=f.reason[:_LONGEST])._asdict()) for f in failures]
    with files.opened(directory / FILE, os.O_RDWR | os.O_CREAT) as descriptor:
        end, last = files.size(descriptor), bytearray(b"\n")
        if end:
            files.read_at(descriptor, memoryview(last), end - 1)
        start = b"" if last == b"\n" else b"\n"  # a line is torn: its writer died
        content = start + "".join(line + "\n" for line in lines).encode()
        files.write_at(descriptor, content, end)


def read(directory: Path) -> list[FailedEpisode]:
    """Return the failures that can be read, in the order of writing."""
    try:
        content = files.read_content(directory / FILE, _LARGEST)
    except OSError:
        return []
    return list(_parse(content))


def _parse(content: bytes) -> Iterator[FailedEpisode]:
    for line in content.splitlines():
        with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError):
            plain = parse_json(line)
            yield FailedEpisode(
                checked(str, plain["mode"], "the mode"),
                whole(plain["campaign"], "the campaign"),
                whole(plain["episode"], "the episode"),
                checked(str, plain["reason"], "the reason"),
            )
