"""ScalarsFile: keeps every recorded number in a CSV file."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from physx_core.components.visualizer import Observer
from physx_core.errors import SessionError

HEADER = ("timeline", "step", "name", "value")
FLUSH_SECONDS = 0.2


class ScalarsFile(Observer):
    """Appends rows (timeline, step, name, value) to ``stats/scalars.csv`` of the session.

    Rows reach the file at least five times a second, and at once those of an epoch: a run that is
    killed keeps its numbers.
    """

    def __init__(self) -> None:
        self._stream: io.TextIOWrapper | None = None
        self._writer: Any = None
        self._flushed = 0.0

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """Open the file, with a header if it is new."""
        folder = session_dir / "stats"
        folder.mkdir(exist_ok=True)
        path = folder / "scalars.csv"
        _cut_unfinished_line(path)
        self._stream = path.open("a", encoding="utf-8", newline="")
        self._writer = csv.writer(self._stream)
        if self._stream.tell() == 0:
            self._writer.writerow(HEADER)

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Append the numbers."""
        if self._stream is None:
            return
        self._writer.writerows([(timeline, step, name, value) for name, value in values.items()])
        now = time.monotonic()
        if timeline != "batch" or now - self._flushed > FLUSH_SECONDS:
            self._flushed = now
            self._stream.flush()

    def end(self) -> None:
        """Let all numbers reach the file."""
        if self._stream is not None:
            self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None


def _cut_unfinished_line(path: Path) -> None:
    """Remove what a killed run wrote of its last line."""
    if path.exists():
        content = path.read_bytes()
        if not content.endswith(b"\n"):
            with path.open("r+b") as stream:
                stream.truncate(content.rfind(b"\n") + 1)


def read_scalars(session_dir: Path) -> dict[tuple[str, str], dict[int, float]]:
    """Return the numbers of a session: (timeline, name) to step to value, in the order of writing.

    Where a resumed run recorded a step again, its number counts. A last line that a killed run
    wrote in part is left out.

    Raises:
        SessionError: The session has no such file, or it is none of physx.
    """
    path = session_dir / "stats" / "scalars.csv"
    if not path.is_file():
        raise SessionError(
            f"There is no {path}: a session has numbers once something was trained in it."
        )
    found: dict[tuple[str, str], dict[int, float]] = {}
    with path.open(encoding="utf-8", newline="") as stream:
        for timeline, step, name, value in _rows(path, stream):
            found.setdefault((timeline, name), {})[step] = value
    return found


def _rows(path: Path, stream: io.TextIOBase) -> Iterator[tuple[str, int, str, float]]:
    lines = csv.reader(line for line in stream if line.endswith("\n"))
    if tuple(next(lines, ())) not in (HEADER, ()):
        raise SessionError(f"{path} is no file of physx: it must begin with {','.join(HEADER)}.")
    for line in lines:
        try:
            timeline, step, name, value = line
            yield timeline, int(step), name, float(value)
        except ValueError as error:
            raise SessionError(f"{path} is damaged: {','.join(line)} ({error}).") from error
