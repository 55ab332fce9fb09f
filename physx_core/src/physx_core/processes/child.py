"""ChildProcess: a process that ends with this one."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import weakref
from collections.abc import Mapping, Sequence

from physx_core.closeable import Closeable
from physx_core.processes.watchdog import WATCHDOG

# The new process waits, as this one may be killed before the watchdog knows about it.
_WAIT_AND_BEGIN = 'read -r line && exec "$@" </dev/null'


class ChildProcess(Closeable):
    """A process that ends with this one, however this one ends, even by SIGKILL.

    It also ends when this object is closed or garbage-collected. It leads its own process group,
    which ends with it and is not reached by Ctrl-C in a terminal. Its standard input is empty. A
    process forked from this one leaves it alone.

    Attributes:
        pid: ID of the process and of its group.
        stderr: Its standard error, if that is a pipe.
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        variables: Mapping[str, str] | None = None,
        stdout: int | None = None,
        stderr: int | None = None,
        pass_fds: Sequence[int] = (),
        detached: bool = False,
    ) -> None:
        """Start the process.

        Args:
            command: Program and arguments.
            variables: Environment variables in addition to those of this process.
            stdout: As in `subprocess.Popen`.
            stderr: As in `subprocess.Popen`.
            pass_fds: As in `subprocess.Popen`.
            detached: Whether it outlives this process and this object unless it is closed.

        Raises:
            OSError: If the process cannot be started.
        """
        if shutil.which(command[0]) is None:
            raise FileNotFoundError(errno.ENOENT, "there is no such program", command[0])
        self._owner, self._is_over, self._is_asked = os.getpid(), False, False
        with WATCHDOG.lock:
            self._process = subprocess.Popen(
                ["/bin/sh", "-c", _WAIT_AND_BEGIN, "sh", *command],
                env={**os.environ, **(variables or {})},
                stdin=subprocess.PIPE,
                stdout=stdout,
                stderr=stderr,
                pass_fds=pass_fds,
                bufsize=0,
                start_new_session=True,
            )
            self.pid, self.stderr = self._process.pid, self._process.stderr
            assert self._process.stdin is not None
            with self._process.stdin as line:  # if it closes without a line, nothing is started
                if not detached:
                    WATCHDOG.add(self.pid)
                    # When the interpreter exits, the watchdog acts after all exit functions.
                    weakref.finalize(self, _abandon, self._process, self._owner).atexit = False
                with contextlib.suppress(BrokenPipeError):  # it is gone, as its status shows
                    line.write(b"\n")

    def exit_status(self) -> int | None:
        """Return the exit status, negative for a signal; None while the process runs."""
        if not self._is_over and self._is_mine() and self._process.poll() is not None:
            self._is_over = True
            _signal_group(self.pid, signal.SIGKILL)  # processes that it left running
            WATCHDOG.remove(self.pid)
        return self._process.returncode

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait until the process ends, for at most `timeout` s; return the `exit_status`."""
        if self._is_mine():
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout)
        return self.exit_status()

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to the process and those that it started."""
        if self._is_mine() and self._process.returncode is None:
            _signal_group(self.pid, number)

    def ask_to_end(self) -> None:
        """Send SIGTERM unless already sent: a second one would end the process immediately."""
        if not self._is_asked:
            self._is_asked = True
            self.send_signal(signal.SIGTERM)

    def close(self, patience: float = 3.0) -> None:
        """End the process; when this returns, nothing of its group is left.

        Args:
            patience: Time in s it has to exit after it is asked to.
        """
        try:
            if patience > 0:
                self.ask_to_end()
                self.wait(patience)
        finally:
            self.send_signal(signal.SIGKILL)
            self.wait()

    def _is_mine(self) -> bool:
        """Return whether this process started it, not a process that this one was forked from."""
        return os.getpid() == self._owner


def _signal_group(group: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS: all are zombies
        os.killpg(group, number)


def _abandon(process: subprocess.Popen[bytes], owner: int) -> None:
    """End a process that is no longer referenced."""
    if os.getpid() == owner and process.returncode is None:
        _signal_group(process.pid, signal.SIGKILL)
        process.wait()
        WATCHDOG.remove(process.pid)
