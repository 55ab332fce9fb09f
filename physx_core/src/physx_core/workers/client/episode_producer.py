"""EpisodeProducer: simulates the episodes that the server leases, and sends what became of them."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

from physx_core.dataset import EpisodeRecord
from physx_core.errors import StateError
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.remote_errors import encode_error
from physx_core.net.values import decode, encode
from physx_core.workers.client.link import WorkerLink
from physx_core.workers.episode_runner import EpisodeBlock, EpisodeRunner
from physx_core.workers.instance import Instance
from physx_core.workers.lease import Begun, Lease
from physx_core.workers.row_codec import pack_rows

if TYPE_CHECKING:
    from physx_core.workers.client.row_files import RowFiles

_MOST_REJECTED = 256


class EpisodeProducer:
    """Runs an instance for a campaign."""

    def __init__(
        self, link: WorkerLink, instance: Instance, row_files: RowFiles | None, state_every: int
    ) -> None:
        """Store what simulates the episodes.

        Args:
            link: The connection to the server.
            instance: Simulates; open.
            row_files: Where the rows are written; None: they are sent.
            state_every: Number of rows after which an episode gives a state; 0: never.
        """
        self._link, self._instance, self._row_files = link, instance, row_files
        self._state_every = state_every
        self._leased: deque[Lease] = deque()
        self._announced = False

    def run(self) -> None:
        """Simulate episodes until the server ends the run."""
        self._link.beat()
        runner = EpisodeRunner(
            self._instance,
            self._take,
            self._refuse,
            state_every=self._state_every,
            clock=self._link.clock,
        )
        while True:
            block = runner.run()
            if block.records:
                self._send(block, runner)
            while not (self._leased or runner.is_busy) or self._link.has_message():
                self._obey(self._link.receive())

    def _take(self) -> Lease | None:
        return self._leased.popleft() if self._leased else None

    def _refuse(self, error: StateError) -> None:
        self._link.send(pack(Kind.STATE, encode_error(error)))

    def _send(self, block: EpisodeBlock, runner: EpisodeRunner) -> None:
        count, rejected = (len(rows.get("step", ())) for rows in (block.rows, block.rejected))
        if (count or rejected) and not self._announced:
            self._announced = True
            self._link.tell_fields(runner.fields)
        if count and self._row_files is not None:
            self._row_files.put(block.rows, count, runner.fields)
        elif count:
            self._link.send_parts(pack_rows(block.rows, count))
        for start in range(0, rejected, _MOST_REJECTED):
            part = {n: each[start : start + _MOST_REJECTED] for n, each in block.rejected.items()}
            self._link.send_parts(pack_rows(part, len(part["step"]), Kind.WRONG))
        records = [_plain(record) for record in block.records]
        state = None if block.state is None else tuple(block.state)
        self._link.send(pack(Kind.EPISODES, encode([records, state]), count))
        if self._row_files is not None:
            self._row_files.tell_sealed()

    def _obey(self, frame: Frame) -> None:
        if frame.kind is Kind.LEASE:
            first, values, begun = decode(frame.payload)
            begun = None if begun is None else Begun(*begun)
            self._leased.append(Lease(range(first, first + frame.number), values, begun))
        elif frame.kind is Kind.PARTITION and self._row_files is not None:
            self._row_files.take(frame)
        else:
            self._link.skip(frame)


def _plain(record: EpisodeRecord) -> tuple[Any, ...]:
    """Return what the server cannot know of an episode."""
    numbers = record.episode, record.count, record.rows, record.part, int(record.status)
    return (*numbers, record.seconds, record.reason, dict(record.fields))
