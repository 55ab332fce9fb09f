"""OutputTail: the last lines of a process's output."""

from __future__ import annotations

import threading
from typing import IO

_BYTES = 8192  # per read
_LINE_BYTES = 140  # kept per line


class OutputTail:
    """Reads what a process writes to a pipe and keeps the last lines."""

    def __init__(self, stream: IO[bytes], lines: int = 60) -> None:
        """Start reading.

        Args:
            stream: The pipe; closed at end of file.
            lines: Number of lines to keep.
        """
        self._bytes, self._lines = b"", lines
        self._reader = threading.Thread(target=self._read, args=(stream,), daemon=True)
        self._reader.start()

    def text(self, patience: float = 0.0) -> str:
        """Return the last lines.

        Args:
            patience: How long to wait for the remaining output, in s, if the process has ended.
        """
        self._reader.join(patience)
        lines = self._bytes.decode(errors="replace").splitlines()
        return "\n".join(lines[-self._lines :])

    def _read(self, stream: IO[bytes]) -> None:
        with stream:
            while chunk := stream.read(_BYTES):
                self._bytes = (self._bytes + chunk)[-self._lines * _LINE_BYTES :]
