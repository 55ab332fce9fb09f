"""Watchdog: a shell that cleans up what this process leaves behind when it dies."""

from __future__ import annotations

import os
import subprocess
import tempfile
import threading
from pathlib import Path

_END = "end"
# Each line names all process groups; once the pipe is closed, the last one counts. Processes take a
# moment to die, during which they may still write to the folder. A scheduler that ends all
# processes of a job may signal this one before the others.
_SCRIPT = (
    'trap "" HUP INT TERM; '
    f'while read -r line; do [ "$line" = {_END} ] && exit; groups=$line; done; '
    'for group in $groups; do kill -s KILL -- "-$group"; done; '
    'rm -rf -- "$1" || { sleep 0.2; rm -rf -- "$1"; }'
)


class Watchdog:
    """Uses a shell to kill process groups and remove files that this process leaves behind.

    The shell reads from a pipe that only this process can write to and that closes when this
    process ends, even by SIGKILL. A process forked from this one closes the pipe immediately and
    starts its own shell when it needs one. The shell exists as long as there are groups or files.

    Attributes:
        lock: Held while a process is started: one forked at that moment would keep the pipes open.
    """

    def __init__(self) -> None:
        """Start without groups and without a shell."""
        self.lock = threading.RLock()  # garbage collection may end a process at any time
        self._groups: set[int] = set()
        self._folder = Path()
        self._shell: subprocess.Popen[bytes] | None = None
        self._sees_forks = False

    def add(self, group: int) -> None:
        """Watch over a process group."""
        with self.lock:
            self._groups.add(group)
            self._start()
            self._write(self._names())

    def remove(self, group: int) -> None:
        """Forget a process group that has ended."""
        with self.lock:
            if group in self._groups:
                self._groups.discard(group)
                self._write(self._names())
                self.stop_if_idle()

    def make_folder(self, prefix: str) -> Path:
        """Create a folder for temporary files; call `stop_if_idle` after removing it."""
        with self.lock:
            self._start()
            self._folder.mkdir(0o700, exist_ok=True)  # a cleanup of /tmp may have removed it
            return Path(tempfile.mkdtemp(prefix=prefix, dir=self._folder))

    def stop_if_idle(self) -> None:
        """Stop the shell if there is nothing left to watch over."""
        with self.lock:
            if self._groups or self._shell is None:
                return
            try:
                self._folder.rmdir()
            except FileNotFoundError:
                pass
            except OSError:  # there are temporary files
                return
            self._write(_END)
            self.release()

    def release(self) -> None:
        """Immediately clean up everything that would be cleaned up after this process."""
        with self.lock:
            self._groups.clear()
            shell, self._shell = self._shell, None
            if shell is not None:
                shell.communicate()

    def _start(self) -> None:
        if self._shell is not None:
            return
        if not self._sees_forks:
            os.register_at_fork(
                before=lambda: self.lock.acquire(),
                after_in_parent=lambda: self.lock.release(),
                after_in_child=self._forget,
            )
            self._sees_forks = True
        self._folder = Path(tempfile.mkdtemp(prefix="physx-"))
        try:
            self._shell = self._open_shell()
        except OSError:
            self._folder.rmdir()
            raise

    def _open_shell(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            ["/bin/sh", "-c", _SCRIPT, "physx-watchdog", str(self._folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            cwd="/",  # keeps no file system busy
            start_new_session=True,
        )

    def _names(self) -> str:
        return " ".join(map(str, sorted(self._groups)))

    def _write(self, line: str) -> None:
        for _ in range(2):
            if self._shell is None or self._shell.stdin is None:
                return
            try:
                os.write(self._shell.stdin.fileno(), f"{line}\n".encode())
                return
            except BrokenPipeError:  # the shell was killed
                self._shell.communicate()
                self._shell = self._open_shell()

    def _forget(self) -> None:
        """Leave everything to the parent, as this process was forked."""
        if self._shell is not None and self._shell.stdin is not None:
            self._shell.stdin.close()
            self._shell.returncode = 0  # it is not a child of this process
        self._groups, self._shell, self.lock = set(), None, threading.RLock()


WATCHDOG = Watchdog()
"""The watchdog of this process."""
