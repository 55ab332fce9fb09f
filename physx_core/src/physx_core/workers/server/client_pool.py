"""ClientPool: the clients of an elastic run, and which of them runs which instances."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.components.launcher import ClientHandle, Launcher
from physx_core.config import EnvironmentConfig
from physx_core.errors import ConfigError, ConnectionRefusedByPeerError, TooFewClientsError
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.liveness import VANISHED
from physx_core.net.remote_errors import encode_error
from physx_core.processes import describe_exit
from physx_core.workers.launchers import describe_states, stop
from physx_core.workers.server.peer import Peer
from physx_core.workers.server.pooled import PooledClient, PooledWorker
from physx_core.workers.server.validation import parse_end, parse_host
from physx_core.workers.tickets import instance_of, make_ticket

_TICK = 0.1
_SAY_EVERY = 5.0
_PING_EVERY = 2.0
_LEAVE_TIME = 0.8  # a process whose connection ended exits a little later
_LONGEST_MESSAGE = 1 << 16
_LOG = logging.getLogger("physx")

Progress = Callable[[int], tuple[int, int | None]]
"""Returns how many rows of an instance there are, and how many are missing; None: unknown."""


class Serving(Protocol):
    """The part of the server that the pool uses."""

    token: str

    def pump(self, timeout: float) -> None:
        """Handle what has arrived."""

    def listen_to(self, peer: Peer, seconds: float) -> None:
        """Handle what one client has sent."""


class ClientPool(Launcher):
    """Distributes the workers of instances over whichever clients are connected.

    Instances wait while there are too few clients. The run's launcher replaces lost clients, up to
    `EnvironmentConfig.restarts` times each; their instances go to others immediately.
    """

    def __init__(
        self,
        config: EnvironmentConfig,
        launcher: Launcher,
        *,
        is_open: bool = False,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        """Store the arguments.

        Args:
            config: How many clients there may be, and how long they may be silent.
            launcher: Starts the clients.
            is_open: Whether others who know the token may start clients, besides the launcher.
            clock: Tells how long clients are silent.

        Raises:
            ConfigError: If more clients are needed than may join.
        """
        self.least = config.min_clients or 1
        self.most = config.max_clients or max(config.num_clients, self.least)
        if self.least > self.most:
            raise ConfigError(
                f"EnvironmentConfig.min_clients is {self.least}, but max_clients lets only "
                f"{self.most} join: the run could not start."
            )
        self._config, self._launcher, self.elsewhere = config, launcher, launcher.elsewhere
        launcher.elastic = True
        self._clock = clock
        self._is_open = is_open or launcher.by_hand
        self._address, self._public = "", ""
        self._server: Serving | None = None
        self._clients: dict[int, PooledClient] = {}
        self._handles: dict[int, ClientHandle] = {}
        self._workers: dict[int, PooledWorker] = {}
        self._waiting: dict[int, PooledWorker] = {}
        self._starts: Counter[int] = Counter()
        self._restarts: Counter[int] = Counter()
        self._last_host: dict[int, PooledClient] = {}
        self._orphans: list[int] = []
        self._short_since: float | None = None
        self._said = 0.0
        self._has_begun = self._is_ending = False
        self._lost = ""  # how the last client was lost

    # Clients -----------------------------------------------------------------------------------

    def open(self) -> str | None:
        """Connect to what starts the clients: see `Launcher.open`."""
        return self._launcher.open()

    def close(self) -> None:
        """End everything that the launcher started: see `Launcher.close`."""
        self._launcher.close()

    def begin(self, address: str, public: str, server: Serving) -> None:
        """Start the clients.

        Args:
            address: ``HOST:PORT`` of the server.
            public: The same for clients on other machines.
            server: The server, open.
        """
        self._address, self._public, self._server = address, public, server
        self._start_clients(range(1, self.most + 1))

    @property
    def peers(self) -> list[Peer]:
        """The connections of the clients."""
        return [client.peer for client in self._clients.values()]

    def admit(self, peer: Peer, wanted: int) -> None:
        """Admit a client that knows the token.

        Args:
            peer: Its connection.
            wanted: The number that it asks for, 0 for any.

        Raises:
            ConnectionRefusedByPeerError: If there is no place for it; it gets the error too.
        """
        self._bury_lost()
        free = [n for n in range(1, self.most + 1) if n not in self._clients]
        if not free or (wanted and wanted not in free):
            name = f"client {wanted}" if wanted else "another client"
            refusal = ConnectionRefusedByPeerError(
                f"The server has no place for {name}: at most {self.most} may join "
                f"(max_clients), and {len(self._clients)} already joined."
            )
            peer.send(pack(Kind.ERROR, encode_error(refusal)))
            raise refusal
        # Prefer numbers that the launcher does not use: its clients ask for theirs.
        foreign = [number for number in free if number not in self._handles]
        peer.client = wanted or (foreign or free)[0]
        peer.reader.limit = _LONGEST_MESSAGE
        self._clients[peer.client] = PooledClient(peer.client, peer, self._clock)
        peer.send(pack(Kind.HOST))

    def redeem(self, ticket: int) -> int:
        """Return the instance that a worker may run.

        Raises:
            ConnectionRefusedByPeerError: If its ticket is not the latest one for the instance.
        """
        worker = self._workers.get(instance_of(ticket))
        if worker is None or worker.ticket != ticket:
            raise ConnectionRefusedByPeerError(
                f"Instance {instance_of(ticket)} is run by another worker now."
            )
        return worker.instance_id

    def take(self, peer: Peer, frame: Frame) -> None:
        """Handle a message from a client."""
        client = self._clients[peer.client]
        client.unanswered = None
        if frame.kind is Kind.HOST and not client.host:
            client.host = parse_host(frame.payload)
            self._assign()
            if self._has_begun:
                _LOG.info("%s joined the run.", _capital(str(client)))
        elif frame.kind is Kind.ENDED:
            status, stderr = parse_end(frame.payload)
            worker = client.workers.get(frame.number)
            if worker is not None:  # it has not been given up
                worker.end(status, stderr)
        elif frame.kind is Kind.BYE:
            peer.finished = True
            peer.close()
        elif frame.kind is not Kind.PING:
            raise ConnectionRefusedByPeerError(
                f"It sent {frame.kind.name}, which a client that runs workers may not send now."
            )

    def check(self, now: float, served_since: float, *, ending: bool = False) -> list[int]:
        """Ping the clients; replace those that do not answer.

        Args:
            now: Monotonic s.
            served_since: Since when the run has listened to its clients, in monotonic s.
            ending: Whether all rows have arrived, so no client has to be replaced.

        Returns:
            The instances that lost clients ran: others must start them.

        Raises:
            TooFewClientsError: If there have been fewer clients than `min_clients` for too long.
        """
        for client in self._clients.values():
            if client.unanswered is None:
                if now - client.pinged > min(_PING_EVERY, self._config.timeout / 4):
                    client.pinged = client.unanswered = now
                    client.peer.send(pack(Kind.PING))
            elif now - max(client.unanswered, served_since) > self._config.timeout:
                self._give_up(client)
        self._is_ending = ending
        self._bury_lost()
        if not ending:
            self._replace_absent()
            self._check_count(now, served_since)
        moved, self._orphans = self._orphans, []
        return moved

    def suspects(self, number: int, served_since: float) -> bool:
        """Return whether the client of a silent instance is silent too; if so, give it up."""
        worker = self._workers.get(number)
        client = None if worker is None else worker.client
        if client is None or client.unanswered is None:
            return False
        silent = self._clock.monotonic() - max(client.unanswered, served_since)
        if silent < self._config.timeout / 4:
            return False
        self._give_up(client)
        return True

    def cut_off(self, number: int) -> None:
        """Give up an instance's client, whose machine no longer answers."""
        client = self._workers[number].client
        if client is not None and not client.peer.closed:
            client.peer.has_vanished = True
            client.peer.close()

    def end(self, patience: float) -> None:
        """Make all clients end their workers and exit; none that was started here is left.

        Args:
            patience: How long the workers may take, in s.
        """
        if self._server is None:
            return
        clients, until = [*self._clients.values()], self._clock.monotonic() + patience + 1.0
        try:
            for client in clients:
                client.peer.send(pack(Kind.CLOSE, number=int(1000 * patience)))
            while self._clock.monotonic() < until and not all(c.peer.closed for c in clients):
                try:
                    self._server.pump(_TICK)
                except Exception:  # of a run that has already failed
                    continue
        finally:
            handles, self._handles = self._handles, {}
            stop(handles.values(), _LEAVE_TIME)

    def _listen(self, peer: Peer, seconds: float) -> None:
        if self._server is not None:
            self._server.listen_to(peer, seconds)

    def _start_clients(self, numbers: Sequence[int]) -> None:
        if self._launcher.by_hand:
            return
        assert self._server is not None
        for handle in self._launcher.launch(numbers, self._address, self._server.token):
            self._handles[handle.instance_id] = handle

    def _give_up(self, client: PooledClient) -> None:
        seconds = self._clock.monotonic() - client.pinged
        client.peer.offense = f"It has not answered for {seconds:.0f} s: it is stopped, or hangs."
        client.peer.close()

    def _bury_lost(self) -> None:
        """Forget lost clients, and have the launcher replace them."""
        for client in [*self._clients.values()]:
            if client.peer.closed:
                self._bury(client)

    def _bury(self, client: PooledClient) -> None:
        peer = client.peer
        del self._clients[client.number]
        handle = self._handles.pop(client.number, None)
        numbers = sorted(worker.instance_id for worker in client.workers.values())
        stderr = ""
        if peer.offense:
            how = f"was cut off. {peer.offense.rstrip('.')}"
        elif peer.has_vanished:
            how = f"was lost: {VANISHED}"
        else:
            how = "left"
            if handle is not None and handle.wait(handle.clock.monotonic() + _LEAVE_TIME):
                how = describe_exit(handle.exit_status() or 0)
                stderr = handle.stderr()
        self._mourn(_capital(str(client)), how, handle, client.number, numbers, stderr)
        self._orphans += numbers

    def _replace_absent(self) -> None:
        """Replace the clients whose processes ended before they joined."""
        for number, handle in [*self._handles.items()]:
            status = handle.exit_status()
            if status is not None and number not in self._clients:
                del self._handles[number]
                how = f"{describe_exit(status)} before it joined"
                self._mourn(f"Client {number}", how, handle, number, [], handle.stderr())

    def _mourn(
        self,
        name: str,
        how: str,
        handle: ClientHandle | None,
        number: int,
        instances: Sequence[int],
        stderr: str,
    ) -> None:
        """Log how a client was lost, and have the launcher replace it."""
        self._lost = f"{name} {how}."
        text = self._lost
        if self._is_ending:
            text += " The run was ending, and it has all its rows."
        elif instances:
            several = "s" if len(instances) > 1 else ""
            text += (
                f" Instance{several} {', '.join(map(str, instances))}: another client takes over."
            )
        if handle is not None:
            stop([handle], 0.0)
            if self._is_ending:
                pass
            elif self._restarts[number] < self._config.restarts:
                self._restarts[number] += 1
                text += f" Restart {self._restarts[number]} of {self._config.restarts}."
                self._start_clients([number])
            else:
                text += f" It is not restarted: restarts is {self._config.restarts}."
        _LOG.warning("%s%s", text, stderr and "\nLast lines of its standard error:\n" + stderr)

    def _check_count(self, now: float, served_since: float) -> None:
        """Report from time to time that clients are missing, and end the run after a while."""
        count = len(self._ready)
        if count >= self.least:
            self._short_since = None
            return
        if self._short_since is None:
            self._short_since = now
        waited = now - max(self._short_since, served_since)
        hopeless = not self._is_open and len(self._handles.keys() | self._clients) < self.least
        if waited > self._config.timeout or hopeless:
            what = "no more can join" if hopeless else f"no other joined for {waited:.0f} s"
            raise TooFewClientsError(
                count,
                self.least,
                f"The run has {_count(count)}, but needs {self.least} (min_clients), and {what}. "
                f"{self._lost or 'None was lost.'} To replace lost clients set "
                "EnvironmentConfig.restarts; if they need longer to start, raise timeout.",
            )
        if waited > _SAY_EVERY and now - self._said > _SAY_EVERY:
            self._said = now
            absent = self._handles.keys() - self._clients
            _LOG.warning(
                "The run has %s and has been waiting for others for %.0f s, at %s%s. It needs %d "
                "(min_clients), and waits no longer than %g s.",
                _count(count),
                waited,
                self._public,
                describe_states(self._handles[number] for number in absent),
                self.least,
                self._config.timeout,
            )

    # Instances ---------------------------------------------------------------------------------

    def launch(self, instances: Sequence[int], address: str, token: str) -> list[ClientHandle]:
        """Have clients start workers for instances, now or once there are enough clients."""
        handles: list[ClientHandle] = []
        for number in instances:
            self._starts[number] += 1
            ticket = make_ticket(number, self._starts[number])
            worker = PooledWorker(number, ticket, self._listen, self._clock)
            former = self._workers.get(number)
            if former is not None and former.client is not None:
                self._last_host[number] = former.client
            self._workers[number] = self._waiting[number] = worker
            handles.append(worker)
        self._assign()
        return handles

    def find_move(
        self, progress: Progress, can_move: Callable[[int], bool] = lambda number: True
    ) -> int | None:
        """Return an instance to move to a client with less to do; None: none.

        It generates its rows again there, so it moves only if it then finishes earlier, assuming
        that the time per row is proportional to the number of instances that a client runs.

        Args:
            progress: How far an instance is.
            can_move: Whether an instance can start again elsewhere.
        """
        ready = self._ready
        if self._waiting or len(ready) < 2:
            return None
        least = min(ready, key=lambda client: client.load)
        most = max(ready, key=lambda client: client.load)
        if most.load - least.load < 2:
            return None
        numbers = [w.instance_id for w in most.workers.values() if can_move(w.instance_id)]
        if not numbers:
            return None
        number = min(numbers, key=lambda number: progress(number)[0])
        made, left = progress(number)
        left = made if left is None else left
        if (made + left) * (least.load + 1) > left * most.load:
            return None
        _LOG.info("Instance %d moves from %s to %s.", number, most, least)
        return number

    def waits(self, number: int) -> bool:
        """Return whether an instance waits for a client."""
        return number in self._waiting

    def is_lost(self, number: int) -> bool:
        """Return whether the client of an instance is lost."""
        worker = self._workers.get(number)
        return worker is not None and worker.is_orphan

    def started(self, number: int) -> float:
        """Return when a client was last told to start an instance, in monotonic s."""
        worker = self._workers.get(number)
        return 0.0 if worker is None or number in self._waiting else worker.started

    def place(self, number: int) -> str:
        """Return the client that runs or ran an instance, and its machine; empty: none."""
        worker = self._workers.get(number)
        return "" if worker is None or worker.client is None else str(worker.client)

    def load(self, number: int) -> int:
        """Return how many instances the client of an instance runs."""
        worker = self._workers.get(number)
        return 1 if worker is None or worker.client is None else max(1, worker.client.load)

    @property
    def _ready(self) -> list[PooledClient]:
        return [c for c in self._clients.values() if c.host and not c.peer.closed]

    def _assign(self) -> None:
        """Have the clients with the least to do start the waiting instances."""
        ready = self._ready
        if len(ready) < self.least:
            return
        self._has_begun = True
        for number, worker in [*self._waiting.items()]:
            former = self._last_host.get(number)
            client = min(ready, key=lambda c: (c.load + (c is former), c.number))
            del self._waiting[number]
            worker.client, worker.started = client, self._clock.monotonic()
            client.workers[worker.ticket] = worker
            client.peer.send(pack(Kind.START, number=worker.ticket))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _count(count: int) -> str:
    return f"{count} client{'s' if count != 1 else ''}"
