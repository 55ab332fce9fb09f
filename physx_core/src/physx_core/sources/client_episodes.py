"""ClientEpisodes: simulates the episodes of a campaign in client processes, over TCP."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.components.environment import Services
from physx_core.config import EnvironmentConfig
from physx_core.errors import ConfigError
from physx_core.fields import Field
from physx_core.net.link import SOCKETS, Transport
from physx_core.rows import ROW_FIELDS
from physx_core.sources.episode_source import EpisodeSource
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.episode_runner import EpisodeBlock
from physx_core.workers.server.client_group import ClientGroup
from physx_core.workers.server.leases import Leases


class ClientEpisodes(EpisodeSource):
    """Gives each number to the next free client, and returns what has ended, in any order."""

    def __init__(
        self,
        config: EnvironmentConfig,
        services: Services,
        seed: Sequence[int],
        queue: EpisodeQueue,
        *,
        transport: Transport = SOCKETS,
    ) -> None:
        """Prepare the clients; see `EpisodeSource` for the arguments.

        Args:
            config: The environment, its sampler, and the number of clients.
            services: Serves the environments' requests.
            seed: Seed of the campaign.
            queue: The numbers to simulate.
            transport: What connects the clients, and the clock that the run follows.
        """
        super().__init__(config, seed, queue)
        self._leases = Leases(queue, self._sets.values_of)
        self._group = ClientGroup(
            config, services, seed, self._sets, leases=self._leases, transport=transport
        )
        self._clients = range(1, config.num_clients + 1)
        self._failed = self._closed = False

    @property
    def fields(self) -> list[Field]:
        """Fields of the rows: see `EpisodeSource.fields`."""
        peers = self._group.server.peers.values()
        told = next((peer.row_fields for peer in peers if peer.row_fields), None)
        return told or [*self._group.peer(1).fields, *ROW_FIELDS]

    def open(self) -> None:
        """Start the clients: see `EpisodeSource.open`."""
        self._failed = True
        if self._config.is_elastic:
            raise ConfigError("min_clients and max_clients are not for episodes: leave them out.")
        self._group.open()
        self._sets.begin([self._group.peer(number).parameters for number in self._clients])
        self._failed = False

    def take(self) -> EpisodeBlock:
        """Wait until something has ended: see `EpisodeSource.take`."""
        self._failed = True
        if not self._leases.blocks and not self._queue.is_done:
            self._group.wait(self._busy)
        self._failed = False
        if not self._leases.blocks:
            return EpisodeBlock({}, [])
        return self._settled(self._leases.blocks.popleft())

    def close(self) -> None:
        """Close the environments and end the clients: see `EpisodeSource.close`."""
        if not self._closed:
            self._closed = True
            self._group.close(orderly=not self._failed)

    def _busy(self) -> list[int]:
        """Give free clients numbers; return those to wait for, none if something has ended."""
        starting = []
        for number in self._clients:
            peer = self._group.server.peers.get(number)
            if peer is None or peer.vacant or not peer.fields:
                starting.append(number)
            elif peer.failure is not None:
                raise peer.failure
            elif not peer.closed:
                self._leases.grant(peer, len(self._clients))
        return [] if self._leases.blocks else self._leases.holders or starting
