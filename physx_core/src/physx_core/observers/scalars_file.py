"""ScalarsFile: stores every recorded number in a CSV file."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from physx_core.components.visualizer import Observer
from physx_core.errors import SessionError, found_at

HEADER = ("timeline", "step", "name", "value")
FIELDS = "fields"
"""Name prefix of row statistics: ``fields/<field>/<component>/<figure>``."""
REPORT_SECONDS = 0.1
"""Time between flushes, and between a training's reports: a killed run loses twice that."""
_LONGEST_LINE = 2**16


class ScalarsFile(Observer):
    """Appends rows (timeline, step, name, value) to the session's ``stats/scalars.csv``.

    Rows are in the file at most 0.2 s after their batch, or when the next one ends; before each
    checkpoint; and those of an epoch immediately, so a killed run keeps its statistics.
    """

    def __init__(self) -> None:
        self._stream: io.TextIOWrapper | None = None
        self._writer: Any = None
        self._flushed = 0.0
        self._path, self._wrote = Path(), False

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """Open the file, with a header if it is new."""
        folder = session_dir / "stats"
        folder.mkdir(exist_ok=True)
        path = folder / "scalars.csv"
        _cut_unfinished_line(path)
        self._path, self._wrote = path, False
        self._stream = path.open("a", encoding="utf-8", newline="")
        self._writer = csv.writer(self._stream)
        if self._stream.tell() == 0:
            self._writer.writerow(HEADER)

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Append the numbers."""
        if self._stream is None:
            return
        self._wrote = True
        self._writer.writerows([(timeline, step, name, value) for name, value in values.items()])
        now = time.monotonic()
        if timeline != "batch" or now - self._flushed > REPORT_SECONDS:
            self._flushed = now
            self._stream.flush()

    def flush(self) -> None:
        """Flush the file."""
        if self._stream is not None:
            self._stream.flush()

    end = flush

    def close(self) -> None:
        """Close the file."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def outputs(self) -> Sequence[str]:
        """Return a line that names the file, if any number was written."""
        return [f"statistics: {self._path}"] if self._wrote else []


def _cut_unfinished_line(path: Path) -> None:
    """Remove an incomplete last line that a killed run left."""
    if path.exists():
        content = path.read_bytes()
        if not content.endswith(b"\n"):
            with path.open("r+b") as stream:
                stream.truncate(content.rfind(b"\n") + 1)


def read_scalars(session: str | Path) -> dict[tuple[str, str], dict[int, float]]:
    """Return a session's statistics: (timeline, name) to step to value, in the order of writing.

    If a resumed run recorded a step again, the later value counts. An incomplete last line is
    ignored.

    Args:
        session: The session's folder.

    Raises:
        SessionError: If the session has no statistics file, or it was not written by physx.
    """
    path = Path(session) / "stats" / "scalars.csv"
    if not path.is_file():
        raise SessionError(
            f"There is no {path}: only training runs write statistics. {found_at(Path(session))}"
        )
    found: dict[tuple[str, str], dict[int, float]] = {}
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            for timeline, step, name, value in _rows(path, stream):
                found.setdefault((timeline, name), {})[step] = value
    except (csv.Error, UnicodeDecodeError, OSError) as error:
        raise SessionError(f"{path} is damaged: {error}.") from error
    return found


def _rows(path: Path, stream: io.TextIOBase) -> Iterator[tuple[str, int, str, float]]:
    lines = csv.reader(_complete_lines(stream))
    if tuple(next(lines, ())) not in (HEADER, ()):
        raise SessionError(
            f"{path} was not written by physx: it must start with {','.join(HEADER)}."
        )
    for line in lines:
        try:
            timeline, step, name, value = line
            yield timeline, int(step), name, float(value)
        except ValueError as error:
            text = ",".join(line)
            raise SessionError(f"{path} is damaged: {text:.200} ({str(error)[:200]}).") from error


def _complete_lines(stream: io.TextIOBase) -> Iterator[str]:
    while line := stream.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE:
            raise csv.Error(f"a line has more than {_LONGEST_LINE} characters")
        if line.endswith("\n"):
            yield line
