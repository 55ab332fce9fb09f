"""ClientGroup: the clients of a run, started together, watched together, ended together."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from physx_core.config import EnvironmentConfig
from physx_core.errors import ClientError, ConfigError
from physx_core.interfaces.environment import Services
from physx_core.plugins import reference_of
from physx_core.transport.handshake import TOKEN_VARIABLE
from physx_core.transport.launcher import ClientProcess, ending, stop
from physx_core.transport.peer import Peer
from physx_core.transport.server import Server
from physx_core.transport.values import encode

_TICK = 0.1
_GRACE = 1.0
_EXIT_TIME = 5.0
_SHORTEST_TOKEN = 16


class ClientGroup:
    """One server and a client for each instance.

    Attributes:
        server: The server.
        config: Which environment, how many clients, and how long they may be silent.
    """

    def __init__(
        self,
        config: EnvironmentConfig,
        services: Services,
        seed: Sequence[int],
        *,
        launch: bool = True,
    ) -> None:
        """Keep what the clients are started with.

        Args:
            config: Which environment, and how many clients.
            services: What the environments may ask of the run.
            seed: Seed of all instances.
            launch: Whether to start the clients; otherwise they are started by hand, with the
                token that the environment variable ``PHYSX_TOKEN`` holds on both sides.
        """
        self.config = config
        self._seed = list(seed)
        self._launch = launch
        self._processes: dict[int, ClientProcess] = {}
        self._exits: dict[int, float] = {}
        self._checked = self._served = 0.0
        token = None if launch else os.environ.get(TOKEN_VARIABLE, "")
        self.server = Server(
            config.ip_address, config.port, config.num_clients, services, self._setup, token
        )

    def open(self) -> None:
        """Start the clients and wait until their environments live.

        Raises:
            ConfigError: The server cannot listen there, or there is no token.
            ClientError: A client did not come to life.
            PhysxError: An environment failed.
        """
        if len(self.server.token) < _SHORTEST_TOKEN:
            raise ConfigError(
                f"Clients that are started by hand need a secret: set {TOKEN_VARIABLE}, at least "
                f"{_SHORTEST_TOKEN} characters, for the server and for each client."
            )
        self._setup(1)  # what cannot travel is named before anything is started
        self.server.open()
        numbers = range(1, self.config.num_clients + 1)
        if self._launch:
            for number in numbers:
                process = ClientProcess(number, self.server.address, self.server.token)
                self._processes[number] = process
                process.start()
        self.wait(lambda: [number for number in numbers if not self._is_ready(number)])

    def peer(self, instance_id: int) -> Peer:
        """Return the connection of an instance's client."""
        return self.server.peers[instance_id]

    def wait(self, missing: Callable[[], Sequence[int]]) -> None:
        """Serve the clients until none is waited for.

        Args:
            missing: Tells the instances that are waited for; called after each round.

        Raises:
            ClientError: A client ended, or one that is waited for is silent for too long.
        """
        began = time.monotonic()
        if began - self._served > _TICK / 10:
            self._serve(0.0)
        while waited := missing():
            self._serve(_TICK)
            if self._silent(waited, began):
                self._serve(0.0)  # an answer may have taken long while others had their say
                self._raise_silent(self._silent(waited, began))

    def _serve(self, timeout: float) -> None:
        self.server.pump(timeout)
        self._served = time.monotonic()
        gone = any(peer.gone for peer in self.server.peers.values())
        if gone or self._served - self._checked > _TICK:
            self._checked = self._served
            self._check_ended(self._served)

    def close(self, *, orderly: bool) -> None:
        """Have the clients close their environments, and end them; no process is left behind.

        Args:
            orderly: Wait for as long as a client may be silent, and raise what goes wrong;
                otherwise wait for a moment and raise nothing.

        Raises:
            ClientError: A client ended too early or is silent for too long.
        """
        patience = 0.0
        try:
            self.server.end()
            if orderly:
                self.wait(self._unfinished)
                patience = _EXIT_TIME
            else:
                self._wait_a_moment()
                patience = 0.0 if self._unfinished() else _GRACE
        finally:
            stop(self._processes.values(), patience)
            self._processes = {}
            self.server.close()

    def _wait_a_moment(self) -> None:
        until = time.monotonic() + _GRACE
        while self._unfinished() and time.monotonic() < until:
            try:
                self.server.pump(_TICK)
            except Exception:  # the run has failed already, with an error of its own
                continue

    def _unfinished(self) -> list[int]:
        peers = self.server.peers.values()
        return [p.instance_id for p in peers if not (p.finished or p.gone or p.failure)]

    def _is_ready(self, number: int) -> bool:
        peer = self.server.peers.get(number)
        if peer is not None and peer.failure is not None:
            raise peer.failure
        return peer is not None and bool(peer.fields)

    def _check_ended(self, now: float) -> None:
        for number in range(1, self.config.num_clients + 1):
            process, peer = self._processes.get(number), self.server.peers.get(number)
            said_why = peer is not None and (peer.failure is not None or peer.finished)
            if said_why or (process is None and (peer is None or not peer.gone)):
                continue
            status = process.exit_status() if process is not None else None
            if peer is not None and peer.gone:
                self._raise_ended(number, peer, process)
            if status is not None and process is not None:
                # What it sent before its end may still be on its way.
                since = self._exits.setdefault(number, now)
                if peer is None or now - since > 2 * _TICK:
                    self._raise_ended(number, peer, process)

    def _raise_ended(self, number: int, peer: Peer | None, process: ClientProcess | None) -> None:
        if process is None:
            raise ClientError(number, "closed the connection. Its own terminal may say why.")
        process.wait(time.monotonic() + 1.0)
        status, made = process.exit_status(), 0 if peer is None else peer.received
        how = "closed the connection" if status is None else ending(status)
        when = "before it connected" if peer is None else f"after {made} rows"
        raise ClientError(
            number,
            f"{how} {when}. To see what it does, run with as_tcp_ip_client=False.",
            exit_status=status,
            stderr=process.stderr(),
        )

    def _silent(self, waited: Sequence[int], began: float) -> list[int]:
        """Return those that let the server wait for too long."""
        limit = time.monotonic() - self.config.timeout
        numbers = sorted(self.server.holding_up(waited))
        peers = ((number, self.server.peers.get(number)) for number in numbers)
        return [number for number, p in peers if max(began, p.heard if p else 0.0) < limit]

    def _raise_silent(self, silent: Sequence[int]) -> None:
        for number in silent:
            process = self._processes.get(number)
            what = "sent nothing" if number in self.server.peers else "did not connect"
            raise ClientError(
                number,
                f"{what} for {self.config.timeout:g} s while the server waited for it. If its "
                "steps take that long, raise EnvironmentConfig.timeout.",
                stderr="" if process is None else process.stderr(),
            )

    def _setup(self, instance_id: int) -> bytes:
        config = self.config
        return encode(
            {
                "environment": reference_of(config.environment),
                "env_kwargs": config.env_kwargs,
                "seed": self._seed,
                "instance_id": instance_id,
                "instance_nb": config.num_clients,
                "simulations_per_step": config.simulations_per_step,
                "max_wrong_samples": config.max_wrong_samples_per_step,
                "draw": config.visualizer is not None,
                "path": [str(Path(entry).resolve()) for entry in sys.path],
                "directory": str(Path.cwd()),
            },
            "EnvironmentConfig",
        )
