"""Messages: JSON between a run and its child process, over a socket."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from typing import Any

from physx_core import Closeable


class Messages(Closeable):
    """One end of a socket, to which any thread may send, and from which one receives."""

    def __init__(self, connected: socket.socket) -> None:
        """Take the socket, which `close` closes."""
        self._socket, self._lines = connected, connected.makefile("rb")
        self._lock = threading.Lock()

    def send(self, **message: Any) -> None:
        """Send a message; do nothing if the other process has ended.

        Raises:
            TypeError: If it is not plain data.
        """
        line = json.dumps(message).encode() + b"\n"
        with self._lock, contextlib.suppress(OSError):
            self._socket.sendall(line)

    def receive(self) -> dict[str, Any] | None:
        """Wait for a message and return it; None: there are no more."""
        try:
            line = self._lines.readline()
        except OSError:
            return None
        if not line.endswith(b"\n"):
            return None
        message: dict[str, Any] = json.loads(line)
        return message

    def finish(self) -> None:
        """Let the other process know that there are no more messages for it."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """Close the socket; calling it again does nothing."""
        self._lines.close()
        self._socket.close()
