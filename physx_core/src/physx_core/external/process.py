"""ProgramProcess: a running program, and the messages to and from it."""

from __future__ import annotations

import os
import shlex
import socket
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from physx_core.closeable import Closeable
from physx_core.errors import ProgramError
from physx_core.external.messages import (
    DESCRIPTION,
    HEADER,
    MalformedMessageError,
    Message,
    check_values,
    pack_answer,
    parse_descriptions,
    parse_header,
)
from physx_core.processes import ChildProcess, OutputTail, TemporaryFolder, describe_exit
from physx_core.typing import Array

Result = TypeVar("Result")

_TICK = 0.1  # s between checks that a silent program still runs
_EXIT_TIME = 2.0  # s for a program to end after it closed its connection
_LINES_TIME = 1.0  # s for the rest of its standard error, if something still keeps that open
_LONGEST_PATH = 107  # bytes, of a socket address


class ProgramProcess(Closeable):
    """A started program that has connected with ``physx_open``.

    It connects to a socket in a folder that only this user can access, and that is removed after
    the connection. An inherited socket would not work, because MPI launchers close those.

    Attributes:
        samples: Number of samples that it has sent.
    """

    def __init__(
        self, command: Sequence[str], variables: Mapping[str, str], timeout: float
    ) -> None:
        """Start the program and wait until it connects.

        Args:
            command: Program and arguments.
            variables: Environment variables that it gets in addition to those of this process.
            timeout: Longest time in s to wait for the program at any point.

        Raises:
            ProgramError: If it cannot be started, or ends or does nothing before it connects.
        """
        self.samples = 0
        self._name, self._timeout = shlex.join(command), timeout
        self._process: ChildProcess | None = None
        self._connection: socket.socket | None = None
        try:
            self._start(command, variables)
        except BaseException:
            self.close()
            raise

    def receive(self) -> Message:
        """Return the next message.

        Raises:
            ProgramError: If the program ends, sends nothing for too long, or violates the protocol.
        """
        try:
            header = parse_header(self._read(bytearray(HEADER.size)))
            place = header.arrays * DESCRIPTION.size
            content = self._read(bytearray(place + header.size))
            given, wanted = parse_descriptions(header, bytes(content[:place]))
            values = {}
            for field in given:
                shape = field.shape or ()
                values[field.name] = np.ndarray(shape, field.numpy_dtype, content, place)
                check_values(field, values[field.name])
                place += field.nbytes
        except MalformedMessageError as error:
            raise self.error(str(error)) from None
        return Message(header.kind, values, wanted)

    def answer(self, values: list[Array]) -> None:
        """Send the arrays that the last message requested, in its order.

        Raises:
            ProgramError: If the program does not receive them.
        """
        for part in pack_answer(values):
            rest = memoryview(part).cast("B")
            while rest:
                sent = self._attempt(partial(self._connected().send, rest))
                rest = rest[sent:]

    def end(self) -> None:
        """Wait for a program that has sent all its samples to end.

        Raises:
            ProgramError: If it does not end, or its exit status is not 0.
        """
        status = self._wait(self._timeout)
        if status is None:
            raise self.error(f"was still running {self._timeout:g} s after physx_close().")
        if status != 0:
            raise self.error(f"{describe_exit(status)} after physx_close().")
        self.close()

    def error(self, message: str) -> ProgramError:
        """End the program and return an error about it.

        Args:
            message: What the program did; completes ``The program ...``.
        """
        status = self._wait(0.0)
        self.close()
        lines = self._tail.text(_LINES_TIME)
        return ProgramError(self._name, message, exit_status=status, stderr=lines)

    def close(self) -> None:
        """End the program and all its child processes; none is left when this returns."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()
        if self._process is not None:
            self._process.close(patience=1.0)

    def _start(self, command: Sequence[str], variables: Mapping[str, str]) -> None:
        with (
            TemporaryFolder("program-") as folder,
            socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener,
        ):
            path = str(folder.path / "s")
            if len(os.fsencode(path)) > _LONGEST_PATH:
                raise ProgramError(
                    self._name,
                    f"cannot be given the address {path}, which is longer than {_LONGEST_PATH} "
                    "bytes: set TMPDIR to a folder with a shorter path.",
                )
            listener.bind(path)
            listener.listen(1)
            listener.settimeout(_TICK)
            try:
                self._process = ChildProcess(
                    command,
                    variables={**variables, "PHYSX_SOCKET": path},
                    stderr=subprocess.PIPE,
                )
            except OSError as error:
                raise ProgramError(
                    self._name, f"cannot be started: {error.strerror}: {command[0]}."
                ) from None
            assert self._process.stderr is not None
            self._tail = OutputTail(self._process.stderr)
            self._connection, _ = self._attempt(listener.accept)
            self._connection.settimeout(_TICK)

    def _read(self, into: bytearray) -> bytearray:
        """Fill a buffer with what the program sends."""
        rest = memoryview(into)
        while rest:
            count = self._attempt(partial(self._connected().recv_into, rest))
            if not count:
                raise self._gone()
            rest = rest[count:]
        return into

    def _attempt(self, call: Callable[[], Result]) -> Result:
        """Repeat a call that times out at each tick while the program does nothing."""
        until = time.monotonic() + self._timeout
        ended = False
        while True:
            try:
                return call()
            except TimeoutError:
                if ended:  # and everything that it sent has been read
                    raise self._gone() from None
                ended = self._wait(0.0) is not None
            except OSError:
                raise self._gone() from None
            if time.monotonic() > until:
                raise self.error(
                    f"did nothing for {self._timeout:g} s. If it needs that long, raise its "
                    'env_kwargs "timeout" and EnvironmentConfig.timeout.'
                )

    def _gone(self) -> ProgramError:
        status = self._wait(_EXIT_TIME)
        how = "closed its connection" if status is None else describe_exit(status)
        when = f"after {self.samples} samples" if self._connection else "before physx_open()"
        return self.error(f"{how} {when}, without physx_close().")

    def _connected(self) -> socket.socket:
        assert self._connection is not None
        return self._connection

    def _wait(self, timeout: float) -> int | None:
        return None if self._process is None else self._process.wait(timeout)
