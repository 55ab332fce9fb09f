"""OutputTail, OutputFile: the last lines of a process's output."""

from __future__ import annotations

import fcntl
import os
import tempfile
from typing import IO

from physx_core.closeable import Closeable
from physx_core.processes.thread import BackgroundThread

_BYTES = 8192  # per read
_LINE_BYTES = 140  # kept per line
_LARGE = 1 << 20


class OutputTail:
    """Reads what a process writes to a pipe and keeps the last lines."""

    def __init__(self, stream: IO[bytes], lines: int = 60) -> None:
        """Start reading.

        Args:
            stream: The pipe; closed at end of file.
            lines: Number of lines to keep.
        """
        self._bytes, self._lines = b"", lines
        self._reader = BackgroundThread(lambda: self._read(stream), "physx-output")
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


class OutputFile(Closeable):
    """A file without a name that takes the output of a process, which may outlive this one.

    Attributes:
        descriptor: What the process writes to.
    """

    def __init__(self, lines: int = 60) -> None:
        """Create the file.

        Args:
            lines: Number of lines to return.
        """
        self._file, self._lines = tempfile.TemporaryFile(buffering=0), lines  # noqa: SIM115
        self.descriptor = self._file.fileno()
        # So that the process goes on at the end of the file after it is trimmed.
        fcntl.fcntl(self.descriptor, fcntl.F_SETFL, os.O_APPEND)

    def text(self) -> str:
        """Return the last lines."""
        size, most = os.fstat(self.descriptor).st_size, self._lines * _LINE_BYTES
        content = os.pread(self.descriptor, most, max(0, size - most))
        return "\n".join(content.decode(errors="replace").splitlines()[-self._lines :])

    def trim(self) -> None:
        """Keep the last lines alone, if the file has become large."""
        if os.fstat(self.descriptor).st_size > _LARGE:
            last = self.text().encode()
            os.ftruncate(self.descriptor, 0)
            os.write(self.descriptor, last + b"\n")

    def close(self) -> None:
        """Close it; the process may go on writing."""
        self._file.close()
