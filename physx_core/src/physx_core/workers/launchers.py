"""The core's launchers: client processes on this machine, or clients started by hand."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from physx_core import cells
from physx_core.components.launcher import ClientHandle, Launcher
from physx_core.errors import ClientError, ConfigError
from physx_core.net.handshake import TOKEN_VARIABLE
from physx_core.processes import ChildProcess, OutputFile, OutputTail, worker_variables
from physx_core.workers.other_python import OtherPython

_TERMINATE_TIME = 0.5


class ClientProcess(ClientHandle):
    """One client, started on this machine.

    Its standard input is empty, its standard output is that of this process, and the last lines of
    its standard error are kept for error messages. Ctrl-C in a terminal does not reach it.

    Attributes:
        instance_id: Number of the instance that it runs, counted from 1.
    """

    def __init__(
        self,
        instance_id: int,
        address: str,
        token: str,
        core: int | None = None,
        detached: bool = False,
        *,
        python: str | None = None,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        """Store the arguments of the process.

        Args:
            instance_id: Number of the instance, counted from 1.
            address: The server's ``HOST:PORT``.
            token: Token of the run.
            core: The only processor core that it may use; None: all that this process may use.
            detached: Whether it outlives this process; it ends with its connection to the server.
            python: The interpreter; None: that of this process.
            variables: Further environment variables.
        """
        self.instance_id = instance_id
        self._core = core
        self._command = [
            *(python or sys.executable, "-P", "-m", "physx_core.workers"),
            *("--connect", address, "--instance", str(instance_id)),
        ]
        self._variables = {**worker_variables(), **(variables or {}), TOKEN_VARIABLE: token}
        self._process: ChildProcess | None = None
        self._tail: OutputTail | None = None
        self._file: OutputFile | None = None
        self._detached = detached

    def start(self) -> None:
        """Start the process.

        Raises:
            ClientError: If it cannot be started.
        """
        try:
            # If this process ended, a pipe would make each line that the client writes an error.
            self._file = OutputFile() if self._detached else None
            with cells.lent() as (variables, descriptors):
                self._process = ChildProcess(
                    self._command,
                    variables={**self._variables, **variables},
                    stderr=subprocess.PIPE if self._file is None else self._file.descriptor,
                    pass_fds=descriptors,
                    detached=self._detached,
                )
        except OSError as error:
            raise ClientError(self.instance_id, f"could not be started: {error}.") from error
        if self._core is not None:
            with contextlib.suppress(ProcessLookupError):  # it has already ended
                os.sched_setaffinity(self._process.pid, {self._core})
        if self._process.stderr is not None:
            self._tail = OutputTail(self._process.stderr)

    @property
    def pid(self) -> int | None:
        """Process id, None before `start`."""
        return self._process.pid if self._process is not None else None

    def exit_status(self) -> int | None:
        """Return the exit status, negative for a signal; None while the process runs."""
        return self._process.exit_status() if self._process is not None else None

    def stderr(self) -> str:
        """Return the last lines that the process wrote to its standard error."""
        if self._file is not None:
            return self._file.text()
        if self._tail is None:
            return ""
        return self._tail.text(0.0 if self.exit_status() is None else 0.2)

    def trim_stderr(self) -> None:
        """Forget all but the last lines of its standard error, if they are in a file."""
        if self._file is not None:
            self._file.trim()

    def terminate(self) -> None:
        """Ask the process and the processes it started to exit."""
        if self._process is not None:
            self._process.ask_to_end()

    def kill(self) -> None:
        """Kill the process and the processes it started."""
        if self._process is not None:
            self._process.send_signal(signal.SIGKILL)

    def wait(self, until: float) -> bool:
        """Wait for the process to end: see `ClientHandle.wait`."""
        return self._process is None or super().wait(until)


class SubprocessLauncher(Launcher):
    """Starts each client as a process on this machine."""

    def __init__(
        self,
        *,
        affinity: bool = False,
        python: str | None = None,
        env: Mapping[str, str] | None = None,
    ) -> None:
        """Store the options.

        Args:
            affinity: Bind each client to one of the processor cores that this process may use, in
                turn. This helps if there are as many busy clients as cores, and hurts if the
                environments use several threads.
            python: Another interpreter that runs the clients, for example "/usr/bin/python3" for
                packages of the system. It needs Python 3.11 and NumPy, not physx.
            env: Environment variables of the clients, in addition to those of this process.

        Raises:
            ConfigError: If an option is malformed, or this machine cannot do it.
        """
        self._python, self._variables = _check_python(python), _check_variables(env)
        self._other: OtherPython | None = None
        self._cores: list[int] = []
        if affinity:
            if not hasattr(os, "sched_setaffinity"):
                raise ConfigError(
                    f"affinity: processes cannot be bound to processor cores on {sys.platform}."
                )
            self._cores = sorted(os.sched_getaffinity(0))

    def open(self) -> str | None:
        """Ask another interpreter whether it can run clients: see `Launcher.open`."""
        if self._python is not None:
            self._other = OtherPython(self._python, self._variables)
            self._variables = self._other.variables
        return None

    def close(self) -> None:
        """Remove what was lent to another interpreter."""
        if self._other is not None:
            self._other.close()

    def launch(self, instances: Sequence[int], address: str, token: str) -> list[ClientHandle]:
        """Start the processes: see `Launcher.launch`."""
        given: dict[str, Any] = {"python": self._python, "variables": self._variables}
        started: list[ClientHandle] = []
        try:
            for number in instances:
                core = self._cores[(number - 1) % len(self._cores)] if self._cores else None
                process = ClientProcess(number, address, token, core, **given)
                started.append(process)
                process.start()
        except BaseException:
            stop(started, 0.0)
            raise
        return started


def _check_python(python: Any) -> str | None:
    if python is not None and not (isinstance(python, str) and python):
        raise ConfigError(
            'python must be the path of an interpreter, such as "/usr/bin/python3", '
            f"not {python!r}."
        )
    return python


def _check_variables(env: Any) -> dict[str, str]:
    given = {} if env is None else env
    if not (isinstance(given, Mapping) and all(map(_is_variable, given.items()))):
        raise ConfigError(
            f'env must be a table of environment variables, such as {{OMP_NUM_THREADS="4"}}, whose '
            f"values are strings, not {env!r}."
        )
    if TOKEN_VARIABLE in given:
        raise ConfigError(f"env must not set {TOKEN_VARIABLE}: see EnvironmentConfig.token_file.")
    return dict(given)


def _is_variable(item: tuple[Any, Any]) -> bool:
    name, value = item
    return (
        isinstance(name, str)
        and isinstance(value, str)
        and bool(name)
        and "=" not in name
        and "\0" not in name + value
    )


class ManualLauncher(Launcher):
    """Starts nothing: users start the clients with ``physx client``, on any machine."""

    by_hand = True

    def launch(self, instances: Sequence[int], address: str, token: str) -> list[ClientHandle]:
        """Start nothing; the server announces where clients can connect."""
        return []


def describe_states(clients: Iterable[ClientHandle]) -> str:
    """Return what absent clients are waiting for, as far as their launcher knows."""
    found = Counter(client.state() for client in clients)
    del found[""]
    return "".join(f"; {count} of them: {state}" for state, count in found.items())


def stop(clients: Iterable[ClientHandle], patience: float) -> None:
    """End clients and all processes they started; none is left when this returns.

    Args:
        clients: The clients.
        patience: Time in s in which they may exit on their own.
    """
    running = list(clients)
    try:
        running = _wait_for(running, patience)
        for client in running:
            client.terminate()
        running = _wait_for(running, _TERMINATE_TIME)
    finally:
        for client in running:
            client.kill()
        _wait_for(running, 10.0)


def _wait_for(clients: list[ClientHandle], patience: float) -> list[ClientHandle]:
    limits = [client.clock.monotonic() + patience for client in clients]
    return [c for c, until in zip(clients, limits, strict=True) if not c.wait(until)]
