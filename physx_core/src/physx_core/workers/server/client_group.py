"""ClientGroup: starts, watches, restarts and ends the clients of a run."""

from __future__ import annotations

import logging
import socket
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from physx_core.components.launcher import ClientHandle
from physx_core.components.services import Services
from physx_core.config import EnvironmentConfig
from physx_core.errors import (
    ClientError,
    PhysxError,
)
from physx_core.net.addresses import format_address, is_loopback, parse_address
from physx_core.net.handshake import TOKEN_VARIABLE
from physx_core.net.link import SOCKETS, Transport
from physx_core.net.tokens import choose_token, find_token
from physx_core.net.values import encode
from physx_core.plugins import create
from physx_core.plugins.references import locate
from physx_core.workers.instance import instance_arguments
from physx_core.workers.journal import Journal
from physx_core.workers.launchers import describe_states, stop
from physx_core.workers.parameter_sets import ParameterSets
from physx_core.workers.pasts import NOTHING, Skip
from physx_core.workers.server.client_errors import exit_error, overdue_error, timeout_error
from physx_core.workers.server.episode_pool import EpisodePool
from physx_core.workers.server.leases import Leases
from physx_core.workers.server.pace import Laggards
from physx_core.workers.server.peer import Peer
from physx_core.workers.server.server import Server
from physx_core.workers.server.stream_pool import StreamPool
from physx_core.workers.server.written_rows import WrittenRows
from physx_core.workers.warned import repeat_warnings

_ALL = ("", "0.0.0.0", "::")  # all addresses of this machine
_TICK = 0.1
_GRACE = 1.0
_BUSY = 1.0
_EXIT_TIME = 5.0
_SAY_EVERY = 5.0
_LOG = logging.getLogger("physx")


class ClientGroup:
    """One server and a client for each instance.

    Attributes:
        server: The server.
        config: The environment, the number of clients, and how long they may be silent.
        journals: What streams were told, by number, if others may go on with them.
    """

    def __init__(
        self,
        config: EnvironmentConfig,
        services: Services,
        seed: Sequence[int],
        sets: ParameterSets,
        *,
        accept_all: bool = False,
        skip: Skip = NOTHING,
        written: WrittenRows | None = None,
        transport: Transport = SOCKETS,
        keeps_pasts: bool = False,
    ) -> None:
        """Store the arguments; `open` starts the clients.

        Args:
            config: The environment, the number of clients, and their launcher.
            services: The services of the run, for the environments.
            seed: Seed of all instances.
            sets: Chooses the instances' parameters.
            accept_all: Whether samples that `check_sample` rejects count like the others.
            skip: What an earlier run already got: clients generate it again, but do not send it.
            written: Takes note of the rows that the clients write themselves; None: they send them.
            transport: What connects the clients, and the clock that the run follows.
            keeps_pasts: Whether a later run may go on.
        """
        self._clock = transport.clock
        self._written = written
        self.config = config
        self._seed = list(seed)
        self._accepts_all = accept_all
        self._launcher = launcher = create("launcher", config.launcher, config.launcher_kwargs)
        launcher.elastic = config.is_elastic
        token = choose_token(config, launcher.by_hand, launcher.elsewhere)
        self._laggards, self._named = Laggards(self._clock), set[str]()
        self._handles: dict[int, ClientHandle] = {}
        self._launched: dict[int, float] = {}
        self._queued: dict[int, float] = {}
        self._exits: dict[int, float] = {}
        self._checked = self._served = self._said = self._began = self._looked = 0.0
        self._host: str | None = None
        pool = (
            self._make_pool()
            if config.is_elastic
            else StreamPool(
                config,
                self._clock,
                sets,
                services,
                skip,
                keeps_pasts=keeps_pasts,
                by_hand=launcher.by_hand,
                address=self._public_address,
            )
        )
        self.journals: dict[int, Journal] = {}
        self.server = Server(
            config, services, self._encode_setup, token, sets, pool, self._reserved, transport
        )
        if isinstance(pool, StreamPool):
            self.journals = pool.journals
            self.server.dispatch.update(pool.dispatch)
        self.server.dispatch.update({} if written is None else written.dispatch)

    def open(self) -> None:
        """Start the clients and wait until their environments are ready."""
        self._encode(1)  # raise for arguments that cannot be sent before anything is started
        self._host = self._launcher.open()
        self.server.open(self._host if is_loopback(self.config.ip_address) else None)
        self._launch(range(1, self.config.num_clients + 1))
        if self._launcher.by_hand:
            count, places = self._pool.least, self.config.places
            most = f" (at most {places} may join)" if self.config.is_elastic else ""
            _LOG.warning(
                "The run waits for %d %s%s. Start each with: physx client --connect %s "
                "(and the token in %s, or in a file with --token-file)",
                count,
                "clients" if count > 1 else "client",
                most,
                self._public_address(),
                TOKEN_VARIABLE,
            )
        self.wait(self._starting)

    def lease(self, leases: Leases) -> None:
        """Have the clients, which are ready, simulate episodes instead of streams."""
        pool = self._pool
        if not isinstance(pool, EpisodePool):
            pool.close()
            self.server.pool = pool = self._make_pool()
        pool.leases = leases
        self.server.dispatch.update(leases.dispatch)

    def refuse(self, peer: Peer, error: PhysxError) -> None:
        """Do without a client that joined the run, or fail if the run started it."""
        if peer.instance_id in self._handles:
            raise error
        self._lose(peer.instance_id, error)

    @property
    def ready(self) -> list[Peer]:
        """The connections of the clients whose environments are ready, in order of instances."""
        return [self.peer(number) for number in self._numbers if self._is_ready(number)]

    def peer(self, instance_id: int) -> Peer:
        """Return the connection of an instance's current or last client."""
        return self.server.peers[instance_id]

    @property
    def absent(self) -> list[int]:
        """The instances that have no client that is ready."""
        ready = {peer.instance_id for peer in self.ready}
        return [number for number in self._numbers if number not in ready]

    def wait(self, missing: Callable[[], Sequence[int]], tick: float = _TICK) -> None:
        """Serve the clients until no instance is missing.

        Args:
            missing: Returns the instances to wait for; called after each round.
            tick: Longest time of a round, in s.
        """
        began = self._clock.monotonic()
        was_busy = began - self._served > _BUSY
        if was_busy:  # what arrived meanwhile may have waited to be read
            for each in self.server.peers.values():
                each.pace.leave_out()
        if self._is_shared and not was_busy:
            began = self._began  # others' episodes end this wait, but not that for a silent client
        self._began = began
        if began - self._served > _TICK / 10:
            self._serve(0.0)
        while waited := missing():
            self._serve(tick)
            self._look_for_laggards(waited)
            if self._served - began < min(_SAY_EVERY, self.config.timeout):
                continue
            self._report_missing(waited, began)
            if self._find_silent(waited, began):
                self._serve(0.0)  # an answer may have arrived while others were served
                for number in self._find_silent(waited, began):
                    peer, handle = self.server.peers.get(number), self._handles.get(number)
                    self._lose(number, timeout_error(number, peer, handle, self.config.timeout))

    def close(self, *, orderly: bool) -> None:
        """Make the clients close their environments, then end them; no process is left behind.

        Args:
            orderly: Wait as long as a client may be silent, and raise errors; otherwise wait
                briefly and raise nothing.
        """
        patience = 0.0
        self._pool.is_ending = True
        try:
            absent = [number for number in self._handles if self._find_peer(number) is None]
            stop([self._handles.pop(number) for number in absent], 0.0)
            self.server.end()
            if orderly:
                self.wait(self._unfinished)
                patience = _EXIT_TIME
            else:
                self._wait_a_moment()
                patience = 0.0 if self._unfinished() else _GRACE
        finally:
            try:
                stop(self._handles.values(), patience)
                repeat_warnings(self._handles.values())
            finally:
                self._handles = {}
                self.server.close()
                self._launcher.close()

    @property
    def _numbers(self) -> range:
        return range(1, self.config.places + 1)

    @property
    def _pool(self) -> StreamPool | EpisodePool:
        return self.server.pool

    @property
    def _is_shared(self) -> bool:
        """Whether any client can simulate what another one does."""
        return isinstance(self._pool, EpisodePool)

    def _make_pool(self) -> EpisodePool:
        is_known = find_token(self.config.token_file) is not None
        is_open = self._launcher.by_hand or is_known
        return EpisodePool(self.config, self._clock, is_open=is_open)

    def _starting(self) -> list[int]:
        """Return the instances that the run waits for before it begins."""
        return [] if len(self.ready) >= self._pool.least else self.absent

    def _reserved(self) -> set[int]:
        """Return the instances for which the launcher has started a client that has not joined."""
        return {number for number in self._handles if self._find_peer(number) is None}

    def _launch(self, numbers: Sequence[int]) -> None:
        now = self._clock.monotonic()
        handles = self._handles_of(numbers)
        self._handles.update(handles)
        self._launched.update(dict.fromkeys(numbers, now))
        without = [number for number in numbers if number not in handles]
        if without and not self._launcher.by_hand:
            raise ClientError(
                without[0],
                f"was not started: {type(self._launcher).__name__}.launch() returned no handle "
                "for it. A launcher that starts nothing must set by_hand = True.",
            )

    def _handles_of(self, numbers: Sequence[int]) -> dict[int, ClientHandle]:
        """Have the launcher start clients; return their handles by instance."""
        call = f"{type(self._launcher).__name__}.launch()"
        try:
            started = self._launcher.launch(numbers, self._address(), self.server.token)
        except PhysxError:
            raise
        except Exception as error:
            text = f"was not started: {call} raised {type(error).__name__}: {error}"
            raise ClientError(numbers[0], text) from error
        handles = list(started) if isinstance(started, Iterable) else [started]
        for each in handles:
            if not isinstance(each, ClientHandle):
                raise ClientError(
                    numbers[0],
                    f"cannot be watched: {call} returned {each!r:.100}, and not a list of handles, "
                    "each of a class derived from ClientHandle.",
                )
        return {handle.instance_id: handle for handle in handles}

    def _address(self) -> str:
        """Return the ``HOST:PORT`` at which clients that the launcher starts reach the server."""
        if self._host is None or self.config.ip_address not in _ALL:
            return self.server.address
        return format_address(self._host, parse_address(self.server.address)[1])

    def _public_address(self) -> str:
        """Return the ``HOST:PORT`` at which other machines reach the server."""
        if self._host is not None or self.config.ip_address not in _ALL:
            return self._address()
        return f"{socket.gethostname()}:{self.server.address.rpartition(':')[2]}"

    def _serve(self, timeout: float) -> None:
        began = self._clock.monotonic()
        self.server.pump(timeout)
        self._served = self._clock.monotonic()
        lost = any(peer.is_lost and not peer.vacant for peer in self.server.peers.values())
        if lost or self._served - self._checked > _TICK:
            self._checked = self._served
            self._check_ended(self._served, began)

    def _wait_a_moment(self) -> None:
        until = self._clock.monotonic() + _GRACE
        while self._unfinished() and self._clock.monotonic() < until:
            try:
                self.server.pump(_TICK)
            except Exception:  # the run has already failed, with its own error
                continue

    def _unfinished(self) -> list[int]:
        peers = self.server.peers.values()
        return [p.instance_id for p in peers if not (p.finished or p.closed or p.failure)]

    def _find_peer(self, number: int) -> Peer | None:
        """Return the connection of an instance's client; None if it has none now."""
        peer = self.server.peers.get(number)
        return None if peer is None or peer.vacant else peer

    def _is_ready(self, number: int) -> bool:
        peer = self._find_peer(number)
        if peer is not None and peer.failure is not None:
            raise peer.failure
        return peer is not None and bool(peer.fields) and not peer.closed

    def _check_ended(self, now: float, listened_since: float) -> None:
        if isinstance(self._pool, EpisodePool) and not self._pool.is_ending:
            self._check_pool(self._pool)
        for number in self._numbers:
            handle, peer = self._handles.get(number), self._find_peer(number)
            if peer is not None and peer.failure is not None:
                if self._pool.replaces(number, peer.failure):
                    self._lose(number, peer.failure)
                continue
            if peer is not None and peer.finished:
                continue
            if peer is not None and peer.closed:
                self._lose(number, exit_error(number, peer, handle))
            elif handle is not None and handle.exit_status() is not None:
                # What it sent before it ended may still be in transit or unread.
                since = self._exits.setdefault(number, now)
                if peer is None or (now - since > 2 * _TICK and peer.heard < listened_since):
                    self._lose(number, exit_error(number, peer, handle))

    def _check_pool(self, pool: EpisodePool) -> None:
        """End clients whose episode takes too long, and the run if there are too few clients."""
        for number, episode, seconds in pool.find_overdue():
            self._lose(number, overdue_error(number, self._handles.get(number), episode, seconds))
        for number in self._numbers if pool.leases is not None else ():
            peer = self._find_peer(number)
            is_guest = peer is not None and not peer.fields and number not in self._handles
            if is_guest and peer is not None and peer.failure is not None:
                self._lose(number, peer.failure)
        ready = [number for number in self._numbers if self._is_ready(number)]
        absent = [h for n, h in self._handles.items() if n not in ready]
        pool.check_count(ready, absent, self._began)

    def _look_for_laggards(self, waited: Sequence[int]) -> None:
        """Report clients that the run waits for because they are much slower than the others."""
        now = self._served
        if self._is_shared or len(self._numbers) < 2 or now - self._looked < _TICK:
            return
        self._looked = now
        late = self.server.holding_up(waited)
        self._laggards.note(late if 2 * len(late) <= len(self._numbers) else (), now)
        peers = self.server.peers
        paces = {n: peer.pace.per_row for n, peer in peers.items() if peer.pace.per_row}
        for number, per_row, median in self._laggards.find(paces):
            place = f"its client at {peers[number].name}"
            if place in self._named:
                continue
            self._named.add(place)
            _LOG.warning(
                "The run waits for instance %d: %s takes %.3g ms for a row, %.1f times as long as "
                "the median of the instances.",
                number,
                place,
                1000 * per_row,
                per_row / median,
            )

    # Replacing clients -----------------------------------------------------------------

    def _lose(self, number: int, error: PhysxError) -> None:
        """Replace a lost client, or do without it; raise its error if that ends the run."""
        peer, handle = self._find_peer(number), self._handles.get(number)
        again = self._pool.lose(number, error, peer, launched=handle is not None)
        self._handles.pop(number, None)
        closes = not isinstance(error, ClientError)  # which takes a moment
        self._vacate(number, handle, _GRACE if closes else 0.0)
        if again and not self._pool.is_ending:
            self._launch([number])

    def _vacate(self, number: int, former: ClientHandle | None, patience: float = 0.0) -> None:
        if self._written is not None and number in self.server.peers:
            self._written.lose(self.server.peers[number])
        self.server.vacate(number)
        stop([] if former is None else [former], patience)
        self._exits.pop(number, None)

    def _report_missing(self, waited: Sequence[int], began: float) -> None:
        """Report from time to time which clients are missing."""
        now = self._clock.monotonic()
        if now - max(began, self._said) < _SAY_EVERY:
            return
        numbers = self._with_client(self.server.holding_up(waited))
        times = {n: now - max(began, self._heard(n)) for n in numbers}
        absent = [n for n in sorted(times) if self._find_peer(n) is None and times[n] > _SAY_EVERY]
        queued = [n for n in absent if self._is_queued(n)]
        if queued and now - self._said < max(times[n] for n in queued) / 2:
            return  # it may take hours
        if absent:
            self._said = now
            _LOG.warning(
                "The run has been waiting for a client to run instance %s for %.0f s, at %s%s. "
                "It waits no longer than %g s%s.",
                ", ".join(map(str, absent)),
                max(times[number] for number in absent),
                self._public_address(),
                describe_states([self._handles[n] for n in absent if n in self._handles]),
                self.config.timeout,
                " once it has left the queue" if queued else "",
            )

    def _heard(self, number: int) -> float:
        peer = self.server.peers.get(number)
        return max(self._launched.get(number, 0.0), peer.heard if peer is not None else 0.0)

    def _with_client(self, numbers: Iterable[int]) -> list[int]:
        """Return the instances that have a client, or need one before the run can go on."""
        return sorted(
            n
            for n in numbers
            if not self._is_shared or n in self._handles or self._find_peer(n) is not None
        )

    def _find_silent(self, waited: Sequence[int], began: float) -> list[int]:
        """Return the instances that have kept the server waiting too long."""
        now = self._clock.monotonic()
        numbers = self._with_client(self.server.holding_up(waited))
        self._queued |= {number: now for number in numbers if self._is_queued(number)}
        since = {n: max(began, self._heard(n), self._queued.get(n, 0.0)) for n in numbers}
        return [number for number in numbers if since[number] < now - self.config.timeout]

    def _is_queued(self, number: int) -> bool:
        """Return whether an instance's client waits for its turn; its time starts after that."""
        handle = self._handles.get(number)
        return handle is not None and self._find_peer(number) is None and handle.is_queued()

    def _encode_setup(self, peer: Peer) -> bytes:
        """Return the first message to a client: its instance, and what the server has from it."""
        skip = {"rows": peer.received, "rejected": peer.rejected.count, "shown": peer.shown}
        first: dict[str, Any] = {"heartbeat": min(_SAY_EVERY, self.config.timeout / 4)}
        if self._written is not None:
            first["folder"] = self._written.describe()
        first["state"] = None if peer.journal is None else peer.journal.newest.describe()
        return self._encode(peer.instance_id, skip=skip, **first)

    def _encode(self, instance_id: int, **progress: Any) -> bytes:
        config = self.config
        return encode(
            {
                **instance_arguments(config, instance_id, self._seed, self._accepts_all),
                "environment": locate("environment", config.environment),
                "draw": config.visualizer is not None,
                "state_every": config.state_every,
                "path": [str(Path(entry).resolve()) for entry in sys.path],
                "directory": str(Path.cwd()),
                **progress,
            },
            "EnvironmentConfig",
        )
