"""Launcher: client processes, each in a process group of its own that is always cleared away."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from typing import IO

from physx_core.errors import ClientError
from physx_core.transport.handshake import TOKEN_VARIABLE

CLIENT_VARIABLE = "PHYSX_CLIENT"
"""Environment variable that is set in every client process."""

_TAIL = 8192
_LINES = 30
_TERMINATE_TIME = 0.5


class ClientProcess:
    """One client, started on this machine.

    Its standard input is empty, its standard output is this process's, and the end of its standard
    error is kept for error messages. Ctrl-C in a terminal does not reach it.

    Attributes:
        instance_id: Number of the instance that it runs, counted from 1.
    """

    def __init__(self, instance_id: int, address: str, token: str) -> None:
        """Keep what the process is started with.

        Args:
            instance_id: Number of the instance, counted from 1.
            address: The server's ``HOST:PORT``.
            token: Token of the run.
        """
        self.instance_id = instance_id
        self._command = [
            *(sys.executable, "-P", "-m", "physx_core.transport"),
            *("--connect", address, "--instance", str(instance_id)),
        ]
        self._variables = {TOKEN_VARIABLE: token, CLIENT_VARIABLE: "1"}
        self._process: subprocess.Popen[bytes] | None = None
        self._reader: threading.Thread | None = None
        self._tail = b""

    def start(self) -> None:
        """Start the process.

        Raises:
            ClientError: The operating system refused.
        """
        # Instances share the processor cores: a numerical library must not take all for each.
        environment = {"OMP_NUM_THREADS": "1", **os.environ, **self._variables}
        try:
            self._process = subprocess.Popen(
                self._command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,
            )
        except OSError as error:
            raise ClientError(self.instance_id, f"could not be started: {error}.") from error
        self._reader = threading.Thread(
            target=self._keep_tail, args=(self._process.stderr,), daemon=True
        )
        self._reader.start()

    @property
    def pid(self) -> int | None:
        """Process id, None before `start`."""
        return self._process.pid if self._process is not None else None

    def exit_status(self) -> int | None:
        """Return the exit status, negative for a signal; None while the process runs."""
        process = self._process
        if process is None or process.returncode is not None:
            return None if process is None else process.returncode
        status = process.poll()
        if status is not None:
            self.signal_group(signal.SIGKILL)  # what the environment left running
        return status

    def stderr(self) -> str:
        """Return the last lines that the process wrote to its standard error."""
        if self._reader is not None and self.exit_status() is not None:
            self._reader.join(0.2)
        lines = self._tail.decode(errors="replace").splitlines()
        return "\n".join(lines[-_LINES:])

    def signal_group(self, number: signal.Signals) -> None:
        """Send a signal to the process and those that it started."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, number)

    def wait(self, until: float) -> bool:
        """Wait for the end of the process; return whether it ended before `until`, monotonic s."""
        while self._process is not None and self.exit_status() is None:
            if time.monotonic() >= until:
                return False
            time.sleep(0.005)
        return True

    def _keep_tail(self, stream: IO[bytes]) -> None:
        with stream:
            while chunk := stream.read(_TAIL):
                self._tail = (self._tail + chunk)[-_TAIL:]


def stop(processes: Iterable[ClientProcess], patience: float) -> None:
    """End processes and all that they started; none is left when this returns.

    Args:
        processes: What to end.
        patience: Time in s for which they may end on their own.
    """
    running = list(processes)
    try:
        running = _still_running(running, patience)
        for process in running:
            process.signal_group(signal.SIGTERM)
        running = _still_running(running, _TERMINATE_TIME)
    finally:
        for process in running:
            process.signal_group(signal.SIGKILL)
        _still_running(running, 10.0)


def _still_running(processes: list[ClientProcess], patience: float) -> list[ClientProcess]:
    until = time.monotonic() + patience
    return [process for process in processes if not process.wait(until)]


def ending(status: int) -> str:
    """Return an exit status in words.

    Args:
        status: Exit status, negative for a signal.
    """
    if status >= 0:
        return f"ended with exit status {status}"
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = "unknown"
    return f"was killed by signal {-status} ({name})"
