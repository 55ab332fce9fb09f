"""Hosting: a client of an elastic run that starts and ends workers as the server directs."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable

from physx_core.errors import ClientError, ConnectionRefusedByPeerError
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.values import encode
from physx_core.processes import describe_exit
from physx_core.workers.client.link import ServerGone, WorkerLink
from physx_core.workers.launchers import ClientProcess, stop
from physx_core.workers.tickets import instance_of

_LOOK_EVERY = 0.05
_NO_START = 127  # like a shell that does not find a program


def host_workers(link: WorkerLink, address: str, token: str, say: Callable[[str], None]) -> None:
    """Start and end workers as the server directs, until it ends the run; then none is left.

    Args:
        link: Connection to the server.
        address: The server's ``HOST:PORT``, for the workers.
        token: Token of the run, for the workers.
        say: Called with a description of what happens.
    """
    hosting = _Hosting(link, address, token, say)
    try:
        hosting.run()
    finally:
        hosting.close()
    with contextlib.suppress(ServerGone):  # the server may have ended first
        link.send(pack(Kind.BYE))
    say("the run has ended")
    link.finish()


class _Hosting:
    def __init__(
        self, link: WorkerLink, address: str, token: str, say: Callable[[str], None]
    ) -> None:
        self._link, self._address, self._token, self._say = link, address, token, say
        self._workers: dict[int, ClientProcess] = {}
        self._stopped: set[int] = set()

    def run(self) -> None:
        """Obey the server until it ends the run, then give the workers time to exit."""
        self._say("waiting for instances to run")
        self._link.send(pack(Kind.HOST, encode(socket.gethostname())))
        while (patience := self._obey()) is None:
            self._report()
        until = self._link.clock.monotonic() + patience
        for worker in self._workers.values():
            worker.wait(until)
        self._report()

    def close(self) -> None:
        """End all workers."""
        workers, self._workers = self._workers, {}
        stop(workers.values(), 0.0)

    def _obey(self) -> float | None:
        """Obey orders that arrive soon; once told to end, return the time allowed for it, in s."""
        seconds = _LOOK_EVERY
        while self._link.has_message(seconds):
            frame = self._link.receive()
            if frame.kind is Kind.CLOSE:
                return frame.number / 1000
            self._take(frame)
            seconds = 0.0
        return None

    def _take(self, frame: Frame) -> None:
        worker = self._workers.get(frame.number)
        if frame.kind is Kind.PING:
            self._link.send(pack(Kind.PING, number=frame.number))
        elif frame.kind is Kind.START:
            self._start(frame.number)
        elif frame.kind is Kind.STOP:
            if worker is not None:
                self._stopped.add(frame.number)
                (worker.kill if frame.payload else worker.terminate)()
        else:
            raise ConnectionRefusedByPeerError(
                f"The server sent {frame.kind.name} to a client that runs workers."
            )

    def _start(self, ticket: int) -> None:
        number = instance_of(ticket)
        worker = ClientProcess(number, self._address, self._token, ticket=ticket)
        try:
            worker.start()
        except ClientError as error:
            self._tell_end(ticket, _NO_START, str(error))
            return
        self._workers[ticket] = worker
        self._say(f"running instance {number}, {len(self._workers)} in total")

    def _report(self) -> None:
        """Tell the server which workers ended."""
        for ticket, worker in [*self._workers.items()]:
            status = worker.exit_status()
            if status is None:
                continue
            del self._workers[ticket]
            how = describe_exit(status)
            if ticket in self._stopped:
                self._stopped.discard(ticket)
                how = "moves to another client, or is restarted"
            self._say(f"instance {instance_of(ticket)} {how}")
            self._tell_end(ticket, status, worker.stderr())

    def _tell_end(self, ticket: int, status: int, stderr: str) -> None:
        payload = encode({"status": status, "stderr": stderr})
        self._link.send(pack(Kind.ENDED, payload, ticket))
