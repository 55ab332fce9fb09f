"""Leases: the server's view of a campaign: which client simulates which numbers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.errors import ConfigError, ConnectionRefusedByPeerError
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.values import decode, encode
from physx_core.typing import Batch
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.episode_runner import EpisodeBlock
from physx_core.workers.row_codec import unpack_rows
from physx_core.workers.server.peer import Peer
from physx_core.workers.server.validation import check_values

_AIM = 20e-3
_MOST = 4096
_STATUS = (EpisodeStatus.FINISHED, EpisodeStatus.FAILED, EpisodeStatus.MORE)


class Leases:
    """Gives numbers to clients, and takes what became of them.

    A client that is fast gets several numbers at once, so that a lease takes about 20 ms; what is
    stored does not depend on that.

    Attributes:
        blocks: What clients have sent and nobody has taken yet.
        dispatch: Handles the messages of a client, by their kind.
    """

    def __init__(
        self,
        queue: EpisodeQueue,
        choose: Callable[[int], dict[str, Any]],
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        """Store what is simulated.

        Args:
            queue: The numbers.
            choose: Returns the parameters of a number.
            clock: Tells how long episodes take.
        """
        self._clock = clock
        self.blocks: deque[EpisodeBlock] = deque()
        self.dispatch: dict[Kind, Callable[[Peer, Frame], None]] = {
            Kind.ROWS: self._take_rows,
            Kind.EPISODES: self._take_episodes,
        }
        self._queue, self._choose = queue, choose
        self._leased: dict[int, dict[int, int]] = {}  # instance to its numbers, with their parts
        self._rows: dict[int, Batch] = {}  # instance to rows whose record has not arrived
        self._suspects: set[int] = set()  # numbers, one of which ended a client; leased alone
        self._pace: dict[int, float] = {}  # instance to the seconds of one of its episodes
        self._since: dict[int, float] = {}  # instance to when it began its present episode

    @property
    def holders(self) -> list[int]:
        """The instances whose clients simulate something."""
        return [number for number, leased in self._leased.items() if leased]

    def grant(self, peer: Peer, clients: int) -> None:
        """Give a client numbers if it has few.

        Args:
            peer: The client; its environment is ready.
            clients: How many clients there are; the last numbers are shared among them.
        """
        leased = self._leased.setdefault(peer.instance_id, {})
        wanted = self._wanted(peer.instance_id, clients)
        if len(leased) > wanted // 2 or not self._suspects.isdisjoint(leased):
            return
        new: list[int] = []
        while len(leased) < wanted and (number := self._queue.take()) is not None:
            if number in self._suspects:
                wanted = 0
                if leased:
                    self._queue.put_back(number)
                    break
            leased[number] = 0
            new.append(number)
        if new:
            if len(leased) == len(new):
                self._since[peer.instance_id] = self._clock.monotonic()
            values = [self._choose(number) for number in new] if peer.parameters else []
            peer.send(pack(Kind.LEASE, encode([new, values]), len(new)))
            peer.pace.go_on()

    def lose(self, instance_id: int) -> int | None:
        """Return a lost client's numbers to the queue.

        Only a number that it held alone counts as lost: of several, any may be the cause, so each
        is leased alone from then on.

        Returns:
            The number that was lost too often, so that it has failed; else None.
        """
        self._rows.pop(instance_id, None)
        leased = list(self._leased.pop(instance_id, {}))
        if len(leased) > 1:  # any of them may be the cause
            self._suspects.update(leased)
            for number in leased:
                self._queue.put_back(number)
            return None
        return None if not leased or self._queue.give_back(leased[0]) else leased[0]

    def release(self, instance_id: int) -> None:
        """Return the numbers of a client that leaves to the queue."""
        self._rows.pop(instance_id, None)
        for number in self._leased.pop(instance_id, {}):
            self._queue.put_back(number)

    def simulated(self) -> list[tuple[int, int, float]]:
        """Return what clients simulate: an instance, its episode, and for how long, in s."""
        now = self._clock.monotonic()
        return [
            (instance, next(iter(leased)), now - self._since[instance])
            for instance, leased in self._leased.items()
            if leased
        ]

    def fail(self, number: int, reason: str) -> None:
        """Record that a number has failed."""
        failed = EpisodeRecord(episode=number, rows=0, status=EpisodeStatus.FAILED, reason=reason)
        self.blocks.append(EpisodeBlock({}, [failed]))

    def _wanted(self, instance_id: int, clients: int) -> int:
        """Return how many numbers a client should have."""
        pace = self._pace.get(instance_id)
        if pace is None or pace > _AIM:
            return 1
        several = 2 * int(_AIM / max(pace, _AIM / _MOST))
        return max(1, min(several, self._queue.waiting // (2 * clients)))

    def _take_rows(self, peer: Peer, frame: Frame) -> None:
        count = frame.number
        if not peer.row_fields or count < 1 or peer.instance_id in self._rows:
            raise ConnectionRefusedByPeerError(f"It sent {count} rows that belong to no episode.")
        self._rows[peer.instance_id] = unpack_rows(frame.payload, peer.row_fields, count)

    def _take_episodes(self, peer: Peer, frame: Frame) -> None:
        rows = self._rows.pop(peer.instance_id, {})
        try:
            records = [_parse(plain) for plain in decode(frame.payload)]
        except (TypeError, ValueError, ConfigError) as error:
            raise ConnectionRefusedByPeerError(f"It sent impossible episodes: {error}.") from error
        leased = self._leased.get(peer.instance_id, {})
        for record in records:
            _settle(leased, record)
            if record.status is not EpisodeStatus.MORE:
                self._since[peer.instance_id] = self._clock.monotonic()
        _check_rows(rows, records)
        if rows:
            check_values(rows, peer.row_fields, peer.instance_id)
        peer.received += len(rows.get("step", ()))
        self._note_pace(peer.instance_id, records)
        self.blocks.append(EpisodeBlock(rows, records, peer.instance_id))

    def _note_pace(self, instance_id: int, records: list[EpisodeRecord]) -> None:
        count = sum(each.count for each in records if each.status is not EpisodeStatus.MORE)
        pace = sum(each.seconds for each in records) / max(1, count)
        self._pace[instance_id] = 0.5 * (pace + self._pace.get(instance_id, pace))


def _settle(leased: dict[int, int], record: EpisodeRecord) -> None:
    """Check that a client has the numbers of a record, and take those that have ended from it.

    Args:
        leased: The numbers that it has, each with its next part.
        record: The record.
    """
    for number in range(record.episode, record.episode + record.count):
        if number not in leased:
            raise ConnectionRefusedByPeerError(f"It sent episode {number}, which it does not have.")
        if record.rows and record.part != leased[number]:
            raise ConnectionRefusedByPeerError(
                f"It sent part {record.part} of episode {number} instead of {leased[number]}."
            )
        if record.status is EpisodeStatus.MORE:
            leased[number] += 1
        else:
            del leased[number]


def _check_rows(rows: Batch, records: list[EpisodeRecord]) -> None:
    """Check that rows are those that the records count."""
    count = len(rows.get("step", ()))
    if count != sum(record.rows for record in records):
        raise ConnectionRefusedByPeerError("It sent another number of rows than episodes have.")
    if not count:
        return
    numbers = [
        number
        for record in records
        for number in (
            range(record.episode, record.episode + record.count)
            if record.count > 1
            else [record.episode] * record.rows
        )
    ]
    if rows["env_id"].any() or not np.array_equal(rows["episode"], numbers):
        raise ConnectionRefusedByPeerError("It sent rows of other episodes.")


def _parse(plain: Any) -> EpisodeRecord:
    """Return the record that a client described.

    Raises:
        TypeError, ValueError, ConfigError: If there can be none such.
    """
    episode, count, rows, part, status, seconds, reason = plain
    if type(reason) is not str:
        raise TypeError("a reason is no text")
    known = EpisodeStatus(status)
    if known not in _STATUS:
        raise ValueError(f"the status {known.name}")
    return EpisodeRecord(
        episode=episode,
        count=count,
        rows=rows,
        part=part,
        status=known,
        seconds=seconds,
        reason=reason,
    )
