"""The clients of an elastic run, and their workers, as the server sees them."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.components.launcher import ClientHandle
from physx_core.net.frames import Kind, pack
from physx_core.workers.server.peer import Peer


class PooledClient:
    """A client that joined.

    Attributes:
        number: Its number, from 1.
        peer: Its connection.
        host: Name of its machine; empty: not reported yet, so the client is not ready.
        workers: The workers that it runs, by their tickets.
        unanswered: Time since which an answer is due, in monotonic s; None: it has answered.
        pinged: When it was last pinged, in monotonic s.
    """

    def __init__(self, number: int, peer: Peer, clock: Clock = SYSTEM_CLOCK) -> None:
        self.number, self.peer, self.host = number, peer, ""
        self.workers: dict[int, PooledWorker] = {}
        self.pinged = clock.monotonic()
        self.unanswered: float | None = self.pinged

    @property
    def load(self) -> int:
        """How many instances it runs."""
        return len(self.workers)

    def __str__(self) -> str:
        """Return its number and its machine."""
        return f"client {self.number} on {self.host or self.peer.name}"


class PooledWorker(ClientHandle):
    """A worker that a client of the pool runs.

    Attributes:
        instance_id: Number of its instance.
        ticket: Ticket that it presents to run the instance.
        client: The client that runs it, or ran it; None: it waits for one.
        started: When the client was told to start it, in monotonic s.
    """

    def __init__(
        self,
        instance_id: int,
        ticket: int,
        listen: Callable[[Peer, float], None],
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self.instance_id, self.ticket = instance_id, ticket
        self.client: PooledClient | None = None
        self.started = math.inf
        self._listen = listen
        self.clock = clock
        self._status: int | None = None
        self._stderr = ""

    @property
    def is_orphan(self) -> bool:
        """Whether its client is lost."""
        return self.client is not None and self.client.peer.closed

    def exit_status(self) -> int | None:
        """Return the exit status that its client reported: see `ClientHandle`."""
        return self._status

    def stderr(self) -> str:
        """Return the last lines of its standard error, once it has ended."""
        return self._stderr

    def end(self, status: int, stderr: str) -> None:
        """Note its end."""
        self._status, self._stderr = status, stderr
        if self.client is not None:
            self.client.workers.pop(self.ticket, None)

    def terminate(self) -> None:
        """Have its client ask it to end."""
        self._stop(b"")

    def kill(self) -> None:
        """Have its client kill it; it counts as ended from now on."""
        self._stop(b"now")
        if self._status is None:
            self.end(-signal.SIGKILL, "")

    def wait(self, until: float) -> bool:
        """Listen to its client until that reports its end: see `ClientHandle.wait`."""
        while self.client is not None and not self.is_orphan and self._status is None:
            left = until - self.clock.monotonic()
            if left <= 0:
                return False
            self._listen(self.client.peer, left)
        return True

    def _stop(self, how: bytes) -> None:
        if self.client is not None and self._status is None:
            self.client.peer.send(pack(Kind.STOP, how, self.ticket))
