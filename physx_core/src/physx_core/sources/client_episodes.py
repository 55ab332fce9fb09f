"""ClientEpisodes: simulates the episodes of a campaign in client processes, over TCP."""

from __future__ import annotations

from collections.abc import Callable

from physx_core.clock import Clock
from physx_core.errors import PhysxError
from physx_core.fields import Field
from physx_core.rows import ROW_FIELDS
from physx_core.sources.episode_source import EpisodeSource
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.episode_runner import EpisodeBlock
from physx_core.workers.parameter_sets import ParameterSets
from physx_core.workers.server.client_group import ClientGroup
from physx_core.workers.server.leases import Leases
from physx_core.workers.server.peer import Peer
from physx_core.workers.server.written_rows import WrittenRows

_TICK = 0.005
"""How long the losses that the next parameters depend on may go unnoticed, in s."""


class ClientEpisodes(EpisodeSource):
    """Gives each number to the next free client, and returns what has ended, in any order."""

    def __init__(
        self,
        group: ClientGroup,
        sets: ParameterSets,
        queue: EpisodeQueue,
        check: Callable[[Peer], None],
        check_canceled: Callable[[], None],
        clock: Clock,
        written: WrittenRows | None,
    ) -> None:
        """Prepare the clients.

        Args:
            group: The clients, open.
            sets: Chooses the parameters of each number.
            queue: The numbers to simulate.
            check: Raises an error if a client's environment differs from the others'.
            check_canceled: Raises an error if the run is over.
            clock: Tells how long episodes take.
            written: Takes note of the rows that clients write themselves; None: they send them.
        """
        super().__init__(sets, queue)
        self._group, self._check, self._check_canceled = group, check, check_canceled
        self._checked: set[Peer] = set()
        self._written = written
        self._leases = Leases(queue, sets.values_of, clock, written)
        group.lease(self._leases)

    @property
    def fields(self) -> list[Field]:
        """Fields of the rows: see `EpisodeSource.fields`."""
        peers = self._group.server.peers.values()
        told = next((peer.row_fields for peer in peers if peer.row_fields), None)
        return told or [*next(peer.fields for peer in peers if peer.fields), *ROW_FIELDS]

    @property
    def is_busy(self) -> bool:
        """Whether clients simulate episodes that are not needed any more."""
        return bool(self._leases.holders)

    def take(self) -> EpisodeBlock:
        """Wait until something has ended: see `EpisodeSource.take`."""
        learned = self._sets.learned
        while not self._leases.blocks and not self._queue.is_done:
            if learned is None:
                self._group.wait(self._busy)
                break
            self._group.wait(self._busy, _TICK)
            learned.wait(0.0 if self._leases.blocks else _TICK)
        if not self._leases.blocks:
            return EpisodeBlock({}, [])
        return self._settled(self._leases.blocks.popleft())

    def _take_again(self, instance_id: int) -> EpisodeBlock:
        def missing() -> list[int]:
            ready = self._group.ready
            others = [peer for peer in ready if peer.instance_id != instance_id]
            for peer in others or ready:
                self._leases.grant(peer, len(ready))
            return [] if self._leases.blocks else self._leases.holders or self._group.absent

        if not self._leases.blocks:
            self._group.wait(missing)
        block = self._leases.blocks.popleft()
        if self._written is None or block.first_row is None:
            return block
        count = sum(record.rows for record in block.records)
        return block._replace(rows=self._written.read(block.first_row, count))

    def _busy(self) -> list[int]:
        """Give free clients numbers; return those to wait for, none if something has ended."""
        self._check_canceled()
        ready = self._group.ready
        for peer in ready:
            if peer not in self._checked:
                try:
                    self._check(peer)
                except PhysxError as error:
                    self._group.refuse(peer, error)
                    continue
                self._checked.add(peer)
            self._leases.grant(peer, len(ready))
        if self._leases.blocks:
            return []
        return self._leases.holders or self._group.absent
