"""ScalarsFile: keeps every recorded number in a CSV file."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from physx_core.interfaces.visualizer import Observer

HEADER = ("timeline", "step", "name", "value")


class ScalarsFile(Observer):
    """Appends rows (timeline, step, name, value) to ``stats/scalars.csv`` of the session."""

    def __init__(self) -> None:
        self._stream: io.TextIOWrapper | None = None
        self._writer: Any = None
        self._written = 0.0

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """Open the file, with a header if it is new."""
        folder = session_dir / "stats"
        folder.mkdir(exist_ok=True)
        self._stream = (folder / "scalars.csv").open("a", encoding="utf-8", newline="")
        self._writer = csv.writer(self._stream)
        if self._stream.tell() == 0:
            self._writer.writerow(HEADER)

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Append the numbers; they reach the file within a second."""
        if self._stream is None:
            return
        for name, value in values.items():
            self._writer.writerow((timeline, step, name, value))
        now = time.monotonic()
        if now - self._written > 1.0:
            self._written = now
            self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None
