"""WorkerProcess: a Python process that runs a module, and the link to it."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence

from physx_core.closeable import Closeable
from physx_core.processes.child import ChildProcess
from physx_core.processes.tail import OutputTail
from physx_core.processes.worker import describe_exit, worker_variables

_PATIENCE = 5.0  # s that a process may take to exit after it closed its link


class WorkerProcess(Closeable):
    """A Python process that runs ``python -m MODULE LINK ...``, connected by a socket pair.

    It ends with this process, or when it is closed: see `ChildProcess`.

    Attributes:
        link: This end of the socket pair; the process gets the descriptor of the other one.
        pid: ID of the process.
    """

    def __init__(
        self,
        module: str,
        *arguments: object,
        pass_fds: Sequence[int] = (),
        variables: Mapping[str, str] | None = None,
        stdout: int | None = None,
    ) -> None:
        """Start the process.

        Args:
            module: The module.
            arguments: Its further arguments.
            pass_fds: Descriptors that the process shares.
            variables: Environment variables in addition to those of this process; None: those of
                `worker_variables`.
            stdout: As in `subprocess.Popen`.

        Raises:
            OSError: If the process cannot be started.
        """
        self.link, theirs = socket.socketpair()
        words = [sys.executable, "-P", "-m", module, str(theirs.fileno()), *map(str, arguments)]
        with theirs:
            try:
                self._process = ChildProcess(
                    words,
                    variables=worker_variables() if variables is None else variables,
                    stdout=stdout,
                    stderr=subprocess.PIPE,
                    pass_fds=[theirs.fileno(), *pass_fds],
                )
            except BaseException:
                self.link.close()
                raise
        assert self._process.stderr is not None
        self._tail = OutputTail(self._process.stderr)
        self.pid = self._process.pid

    def exit_status(self) -> int | None:
        """Return the exit status, negative for a signal; None while the process runs."""
        return self._process.exit_status()

    def wait(self, timeout: float) -> int | None:
        """Wait until the process ends, for at most `timeout` s; return the `exit_status`."""
        return self._process.wait(timeout)

    def describe_end(self, patience: float = _PATIENCE) -> str:
        """Describe how the process ended that closed its link, given a time to exit in s."""
        status = self._process.wait(patience)
        return "closed its link" if status is None else describe_exit(status)

    def stderr(self, patience: float = 0.3) -> str:
        """Return the last lines of its standard error, waiting for them if it has ended."""
        return self._tail.text(patience)

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to the process and those that it started."""
        self._process.send_signal(number)

    def ask_to_end(self) -> None:
        """Send SIGTERM unless already sent."""
        self._process.ask_to_end()

    def close(self, patience: float = 0.0) -> None:
        """End the process, which has `patience` s to exit, and close the link."""
        try:
            self._process.close(patience)
        finally:
            self.link.close()
