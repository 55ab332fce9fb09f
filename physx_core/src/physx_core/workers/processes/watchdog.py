"""Watchdog: kills the process groups of clients if this process dies."""

from __future__ import annotations

import contextlib
import os
import subprocess
import threading

_END = "end"
# Each line names all process groups; the last one counts once the pipe is closed.
_SCRIPT = (
    f'while read -r line; do [ "$line" = {_END} ] && exit; groups=$line; done; '
    'for group in $groups; do kill -s KILL -- "-$group"; done'
)


class Watchdog:
    """Has a shell kill the process groups of clients that this process leaves behind.

    A client whose server is gone exits on its own, unless it is stopped, or an engine keeps it from
    running any Python. The shell reads from a pipe to which only this process can write, and which
    closes when this process ends, even by SIGKILL (and when those that it forked end, which hold
    the pipe too). There is a shell as long as there are groups.
    """

    def __init__(self) -> None:
        """Start with no groups, and no shell."""
        self._groups: set[int] = set()
        self._shell: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()

    def add(self, group: int) -> None:
        """Watch over a process group."""
        with self._lock:
            self._groups.add(group)
            if self._shell is None:
                with contextlib.suppress(OSError):  # without it clients still exit on their own
                    self._shell = subprocess.Popen(
                        ["/bin/sh", "-c", _SCRIPT],
                        stdin=subprocess.PIPE,
                        stdout=subprocess.DEVNULL,
                        stderr=subprocess.DEVNULL,
                        bufsize=0,
                        start_new_session=True,
                    )
            self._tell()

    def remove(self, group: int) -> None:
        """Forget a process group that has ended."""
        with self._lock:
            self._groups.discard(group)
            self._tell()
            if not self._groups and self._shell is not None:
                self._write(_END)  # a forked process may hold the pipe open for long
                shell, self._shell = self._shell, None
                shell.communicate()

    def _tell(self) -> None:
        self._write(" ".join(map(str, sorted(self._groups))))

    def _write(self, line: str) -> None:
        if self._shell is not None and self._shell.stdin is not None:
            with contextlib.suppress(OSError):  # somebody killed the shell
                os.write(self._shell.stdin.fileno(), f"{line}\n".encode())
