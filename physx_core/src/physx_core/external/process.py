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
    Kind,
    MalformedMessageError,
    Message,
    check_values,
    pack_answer,
    parse_descriptions,
    parse_header,
)
from physx_core.external.parts import Division, Part, read_part
from physx_core.fields import Field
from physx_core.processes import ChildProcess, OutputTail, TemporaryFolder, describe_exit
from physx_core.typing import Array

Result = TypeVar("Result")

_TICK = 0.1  # s between checks that a silent program still runs
_EXIT_TIME = 2.0  # s for a program to end after it closed its connection
_LINES_TIME = 1.0  # s for the rest of its standard error, if something still keeps that open
_LONGEST_PATH = 107  # bytes, of a socket address


class ProgramProcess(Closeable):
    """A started program that has connected with ``physx_open``, or several ranks of one.

    It connects to a socket in a folder that only this user can access, and that is removed after
    the connection. An inherited socket would not work, because MPI launchers close those.

    Attributes:
        fields: The fields that it declared.
        samples: Number of samples that it has sent.
    """

    def __init__(
        self, command: Sequence[str], variables: Mapping[str, str], timeout: float
    ) -> None:
        """Start the program and wait until it has declared its fields.

        Args:
            command: Program and arguments.
            variables: Environment variables that it gets in addition to those of this process.
            timeout: Longest time in s to wait for the program at any point.

        Raises:
            ProgramError: If it cannot be started, or does something else.
        """
        self.samples = 0
        self.fields: Sequence[Field] = ()
        self._name, self._timeout = shlex.join(command), timeout
        self._process: ChildProcess | None = None
        self._connections: list[socket.socket] = []  # in order of ranks, once all have connected
        self._ranks = 1
        self._division: Division | None = None
        self._wanted: list[tuple[Field, ...]] = []
        try:
            self._start(command, variables)
        except BaseException:
            self.close()
            raise

    @property
    def is_over(self) -> bool:
        """Whether it was closed, for example because of an error."""
        return not self._connections

    def receive(self) -> Message:
        """Return the next message; if there are several ranks, what theirs are together.

        Raises:
            ProgramError: If the program ends, sends nothing for too long, or violates the protocol.
        """
        messages = [self._receive(rank) for rank in range(len(self._connections))]
        self._wanted = [message.wanted for message in messages]
        return self._understood(partial(self._merge, messages))

    def answer(self, values: Mapping[str, Array]) -> None:
        """Send the arrays that the last message requested.

        Raises:
            ProgramError: If the program does not receive them.
        """
        for rank, wanted in enumerate(self._wanted):
            for part in pack_answer([self._part(rank, field, values) for field in wanted]):
                rest = memoryview(part).cast("B")
                while rest:
                    sent = self._attempt(
                        partial(self._connections[rank].send, rest), self._where(rank)
                    )
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
        connections, self._connections = self._connections, []
        for connection in connections:
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
            listener.listen()
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
            self._accept(listener)

    def _accept(self, listener: socket.socket) -> None:
        """Have the program connect and declare its fields, in each of its ranks."""
        message = self._receive(self._connect(listener))
        if message.kind is Kind.PART:
            self._accept_ranks(listener, self._understood(partial(read_part, message)))
            return
        self.fields = self._check_fields(message)

    def _accept_ranks(self, listener: socket.socket, first: Part) -> None:
        parts, found = [first], {first.rank: self._connections[0]}
        while len(found) < first.ranks:
            missing = min(set(range(first.ranks)) - found.keys())
            number = self._connect(listener, missing)
            message = self._receive(number)
            part = self._understood(partial(read_part, message))
            if part.ranks != first.ranks or part.rank in found:
                raise self.error(
                    f"called physx_open_part() in rank {part.rank} of {part.ranks}, after rank "
                    f"{first.rank} of {first.ranks}: each rank calls it once."
                )
            parts.append(part)
            found[part.rank] = self._connections[number]
        self._connections = [found[rank] for rank in range(first.ranks)]
        self._ranks = first.ranks
        parts.sort()
        declared = [self._check_fields(self._receive(rank), rank) for rank in range(first.ranks)]
        self._division = self._understood(partial(Division, parts, declared))
        self.fields = tuple(self._division.fields)

    def _connect(self, listener: socket.socket, rank: int | None = None) -> int:
        """Wait for a connection, that of a rank if there are several; return its number."""
        connection, _ = self._attempt(listener.accept, "" if rank is None else f" in rank {rank}")
        connection.settimeout(_TICK)
        self._connections.append(connection)
        return len(self._connections) - 1

    def _check_fields(self, message: Message, rank: int = 0) -> tuple[Field, ...]:
        if message.kind is not Kind.FIELDS or not (message.wanted or rank):
            raise self.error("declared no fields in physx_open().")
        return message.wanted

    def _merge(self, messages: list[Message]) -> Message:
        return messages[0] if self._division is None else self._division.merge(messages)

    def _part(self, rank: int, field: Field, values: Mapping[str, Array]) -> Array:
        whole = values[field.name]
        return whole if self._division is None else self._division.divide(rank, field, whole)

    def _receive(self, rank: int) -> Message:
        """Return the next message of a connection."""

        def parse() -> Message:
            header = parse_header(self._read(bytearray(HEADER.size), rank))
            place = header.arrays * DESCRIPTION.size
            content = self._read(bytearray(place + header.size), rank)
            given, wanted = parse_descriptions(header, bytes(content[:place]))
            values = {}
            for field in given:
                shape = field.shape or ()
                values[field.name] = np.ndarray(shape, field.numpy_dtype, content, place)
                check_values(field, values[field.name])
                place += field.nbytes
            return Message(header.kind, values, wanted)

        return self._understood(parse)

    def _understood(self, call: Callable[[], Result]) -> Result:
        """Return what a call returns that parses something of the program."""
        try:
            return call()
        except MalformedMessageError as error:
            raise self.error(str(error)) from None

    def _read(self, into: bytearray, rank: int) -> bytearray:
        """Fill a buffer with what the program sends."""
        rest, where = memoryview(into), self._where(rank)
        while rest:
            count = self._attempt(partial(self._connections[rank].recv_into, rest), where)
            if not count:
                raise self._gone(where)
            rest = rest[count:]
        return into

    def _attempt(self, call: Callable[[], Result], where: str = "") -> Result:
        """Repeat a call that times out at each tick while the program does nothing."""
        until = time.monotonic() + self._timeout
        ended = False
        while True:
            try:
                return call()
            except TimeoutError:
                if ended:  # and everything that it sent has been read
                    raise self._gone(where) from None
                ended = self._wait(0.0) is not None
            except OSError:
                raise self._gone(where) from None
            if time.monotonic() > until:
                raise self.error(
                    f"did nothing{where} for {self._timeout:g} s. If it needs that long, raise "
                    'its env_kwargs "timeout" and EnvironmentConfig.timeout.'
                )

    def _gone(self, where: str) -> ProgramError:
        status = self._wait(_EXIT_TIME)
        how = "closed its connection" if status is None else describe_exit(status)
        when = f"after {self.samples} samples" if self._connections else "before physx_open()"
        return self.error(f"{how}{where} {when}, without physx_close().")

    def _where(self, rank: int) -> str:
        return f" in rank {rank}" if self._ranks > 1 else ""

    def _wait(self, timeout: float) -> int | None:
        return None if self._process is None else self._process.wait(timeout)
