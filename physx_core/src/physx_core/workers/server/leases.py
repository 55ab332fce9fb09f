"""Leases: the server's view of a campaign: which client simulates which numbers."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.errors import ConfigError, ConnectionRefusedByPeerError
from physx_core.fields import Field
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.remote_errors import decode_error
from physx_core.net.values import decode, encode
from physx_core.rows import concatenate
from physx_core.typing import Batch, Index
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.episode_runner import EpisodeBlock
from physx_core.workers.instance import MOST_REJECTED
from physx_core.workers.lease import (
    AIM,
    EpisodeState,
    Lease,
    most_numbers,
    say_without_states,
)
from physx_core.workers.row_codec import unpack_rows
from physx_core.workers.server.peer import Peer
from physx_core.workers.server.validation import check_values
from physx_core.workers.server.written_rows import WrittenRows

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
        choose: Callable[[range], Batch],
        clock: Clock = SYSTEM_CLOCK,
        written: WrittenRows | None = None,
    ) -> None:
        """Store what is simulated.

        Args:
            queue: The numbers.
            choose: Returns the parameters of numbers: see `ParameterSets.values_of`.
            clock: Tells how long episodes take.
            written: Takes note of the rows that clients write themselves; None: they send them.
        """
        self._clock, self._written = clock, written
        self.blocks: deque[EpisodeBlock] = deque()
        rows = {Kind.ROWS: self._take_rows} if written is None else {Kind.WRITTEN: self._take_place}
        self.dispatch: dict[Kind, Callable[[Peer, Frame], None]] = {
            **rows,
            Kind.WRONG: self._take_rejected,
            Kind.EPISODES: self._take_episodes,
            Kind.STATE: self._take_refusal,
        }
        self._queue, self._choose = queue, choose
        self._held: dict[int, _Held] = {}  # by instance
        self._has_no_states = False
        self._suspects: set[int] = set()  # numbers, one of which ended a client; leased alone

    @property
    def holders(self) -> list[int]:
        """The instances whose clients simulate something."""
        return [instance_id for instance_id, held in self._held.items() if held.count]

    def grant(self, peer: Peer, clients: int) -> None:
        """Give a client numbers if it has few.

        Args:
            peer: The client; its environment is ready.
            clients: How many clients there are; the last numbers are shared among them.
        """
        held = self._held.setdefault(peer.instance_id, _Held())
        wanted = held.wanted(most_numbers(peer.parameters))
        wanted = max(1, min(wanted, self._queue.waiting // (2 * clients)))
        if held.count > wanted // 2 or self._has_suspect(*held.left):
            return
        while held.count < wanted:
            numbers = self._queue.take_range(wanted - held.count)
            is_suspect = self._has_suspect(numbers)
            if is_suspect and held.count:
                self._queue.put_back(numbers[0])
            elif numbers:
                self._lease(peer, numbers)
            if is_suspect or not numbers:
                return

    def _has_suspect(self, *numbers: range) -> bool:
        return any(number in each for number in self._suspects for each in numbers)

    def _lease(self, peer: Peer, numbers: range) -> None:
        values = self._choose(numbers) if peer.parameters else {}
        lease = Lease(numbers, values, self._queue.begun(numbers[0]))
        self._held[peer.instance_id].add(lease, self._clock.monotonic())
        begun = None if lease.begun is None else tuple(lease.begun)
        peer.send(pack(Kind.LEASE, encode([numbers[0], values, begun]), len(numbers)))
        peer.pace.go_on()

    def lose(self, instance_id: int) -> int | None:
        """Return a lost client's numbers to the queue.

        Only a number that it held alone counts as lost: of several, any may be the cause, so each
        is leased alone from then on.

        Returns:
            The number that was lost too often, so that it has failed; else None.
        """
        held = self._held.pop(instance_id, _Held())
        if held.count == 1:
            lost = held.first
            return None if self._queue.give_back(lost) else lost
        for number in itertools.chain(*held.left):  # any of them may be the cause
            self._suspects.add(number)
            self._queue.put_back(number)
        return None

    def release(self, instance_id: int) -> None:
        """Return the numbers of a client that leaves to the queue."""
        for number in itertools.chain(*self._held.pop(instance_id, _Held()).left):
            self._queue.put_back(number)

    def simulated(self) -> list[tuple[int, int, float]]:
        """Return what clients simulate: an instance, its episode, and for how long, in s."""
        now = self._clock.monotonic()
        return [
            (instance_id, held.first, now - held.since)
            for instance_id, held in self._held.items()
            if held.count
        ]

    def fail(self, number: int, reason: str) -> None:
        """Record that a number has failed."""
        alone = range(number, number + 1)
        failed = EpisodeRecord(
            episode=number,
            rows=0,
            status=EpisodeStatus.FAILED,
            parameters=Lease(alone, self._choose(alone)).parameters(number, 1),
            reason=reason,
        )
        self.blocks.append(EpisodeBlock({}, [failed]))

    def _take_rows(self, peer: Peer, frame: Frame) -> None:
        held, count = self._held.get(peer.instance_id), frame.number
        if held is None or not peer.row_fields or count < 1 or held.rows:
            raise ConnectionRefusedByPeerError(f"It sent {count} rows that belong to no episode.")
        held.rows = unpack_rows(frame.payload, peer.row_fields, count)

    def _take_place(self, peer: Peer, frame: Frame) -> None:
        held = self._held.get(peer.instance_id)
        if held is None or held.first_row is not None:
            raise ConnectionRefusedByPeerError("It wrote rows that belong to no episode.")
        held.first_row = frame.number

    def _take_rejected(self, peer: Peer, frame: Frame) -> None:
        held, count = self._held.get(peer.instance_id), frame.number
        if held is None or not peer.row_fields or count < 1:
            raise ConnectionRefusedByPeerError(f"It sent {count} rejected rows of no episode.")
        if count + sum(len(rows["step"]) for rows in held.rejected) >= 2 * MOST_REJECTED:
            raise ConnectionRefusedByPeerError("It sent more rejected rows than are kept.")
        rows = unpack_rows(frame.payload, peer.row_fields, count)
        check_values(rows, peer.row_fields, peer.instance_id)
        held.rejected.append(rows)

    def _take_episodes(self, peer: Peer, frame: Frame) -> None:
        held = self._held.get(peer.instance_id, _Held())
        rows, held.rows = held.rows, {}
        first_row, held.first_row = held.first_row, None
        rejected, held.rejected = concatenate(held.rejected), []
        try:
            plain, state = decode(frame.payload)
            records = [_parse(each, peer.episode_fields) for each in plain]
        except (AttributeError, TypeError, ValueError, ConfigError) as error:
            raise ConnectionRefusedByPeerError(f"It sent impossible episodes: {error}.") from error
        before = held.count
        records = [held.settled(record) for record in records]
        state = None if state is None else _parse_state(state)
        if held.count < before:
            held.since = self._clock.monotonic()
        count = sum(record.rows for record in records)
        if first_row is None:
            _check_rows(rows, records, count)
        if rows:
            check_values(rows, peer.row_fields, peer.instance_id)
        _check_fields(records, peer)
        _check_rejected(rejected, records)
        if self._written is not None and first_row is not None:
            self._written.take(peer, first_row, count)
        peer.received += count
        held.note_pace(records)
        self._follow(records, state)
        self.blocks.append(
            EpisodeBlock(rows, records, peer.instance_id, rejected, first_row, state)
        )

    def _follow(self, records: list[EpisodeRecord], state: EpisodeState | None) -> None:
        """Note what there is of episodes; the state is of the last one."""
        last = len(records) - 1
        try:
            for place, record in enumerate(records):
                self._queue.follow(record, state if place == last else None)
        except ValueError as error:
            raise ConnectionRefusedByPeerError(f"It sent {error}.") from error

    def _take_refusal(self, peer: Peer, frame: Frame) -> None:
        if frame.number:
            raise ConnectionRefusedByPeerError("It sent a state of no episode.")
        if not self._has_no_states:
            self._has_no_states = True
            say_without_states(peer.instance_id, decode_error(frame.payload))


class _Held:
    """What a client has leased.

    Attributes:
        rows: Rows whose record has not arrived.
        first_row: Address of rows that it has written and whose record has not arrived.
        rejected: Rejected ones.
        since: When it began its present episode, in monotonic s.
    """

    def __init__(self) -> None:
        self.rows: Batch = {}
        self.first_row: int | None = None
        self.rejected: list[Batch] = []
        self.since = 0.0
        self._leases: list[tuple[Lease, range]] = []  # with numbers that have not ended
        self._parts: dict[int, int] = {}  # number of an episode that has begun to its next part
        self._pace: float | None = None  # seconds of an episode
        self._spent = 0.0  # seconds of the parts of one that has not ended

    @property
    def left(self) -> list[range]:
        """The numbers that have not ended."""
        return [left for _, left in self._leases]

    @property
    def count(self) -> int:
        """How many numbers have not ended."""
        return sum(map(len, self.left))

    @property
    def first(self) -> int:
        """The least of them."""
        return min(each[0] for each in self.left)

    def wanted(self, most: int) -> int:
        """Return how many numbers it should have: for 20 ms, and as many for the meantime.

        Args:
            most: The most that one lease may have.
        """
        pace = self._pace
        return 1 if pace is None or pace > AIM else 2 * int(AIM / max(pace, AIM / most))

    def note_pace(self, records: list[EpisodeRecord]) -> None:
        """Take note of what episodes have cost."""
        count = sum(each.count for each in records if each.status is not EpisodeStatus.MORE)
        spent = self._spent + sum(each.seconds for each in records)
        self._spent = 0.0 if count else spent
        pace, before = spent / max(1, count), self._pace or 0.0
        if count or pace > before:  # a part of an episode tells only that it is longer
            self._pace = 0.5 * (pace + (before or pace))

    def add(self, lease: Lease, now: float) -> None:
        """Give it more numbers."""
        self.since = self.since if self._leases else now
        if lease.begun is not None:
            self._parts[lease.numbers[0]] = lease.begun.part
        self._leases.append((lease, lease.numbers))

    def settled(self, record: EpisodeRecord) -> EpisodeRecord:
        """Return a record with its parameters, and take the numbers that have ended.

        Raises:
            ConnectionRefusedByPeerError: If the client does not have the numbers of the record, or
                it is not about the next part.
        """
        first, ended = record.episode, range(record.episode, record.episode + record.count)
        having = (k for k, left in enumerate(self.left) if first in left and ended[-1] in left)
        if (place := next(having, None)) is None:
            raise ConnectionRefusedByPeerError(
                f"It sent episode {first}, which it does not have, or those that follow it."
            )
        lease, left = self._leases[place]
        part = self._parts.get(first, 0)
        if record.rows and record.part not in (0, part):  # it may begin anew
            raise ConnectionRefusedByPeerError(
                f"It sent part {record.part} of episode {first} instead of {part}."
            )
        if record.status is EpisodeStatus.MORE:
            self._parts[first] = record.part + 1
        else:
            self._parts.pop(first, None)
            rest = range(left.start, first), range(ended.stop, left.stop)
            self._leases[place : place + 1] = [(lease, each) for each in rest if each]
        if not lease.values:
            return record
        return replace(record, parameters=lease.parameters(first, record.count))


def _check_rows(rows: Batch, records: list[EpisodeRecord], count: int) -> None:
    """Check that rows are those that the records count."""
    if count != len(rows.get("step", ())):
        raise ConnectionRefusedByPeerError("It sent another number of rows than episodes have.")
    if not count:
        return
    numbers = np.concatenate([_numbers(record) for record in records])
    if rows["env_id"].any() or not np.array_equal(rows["episode"], numbers):
        raise ConnectionRefusedByPeerError("It sent rows of other episodes.")


def _check_rejected(rows: Batch, records: list[EpisodeRecord]) -> None:
    """Check that rejected rows are of the episodes that have ended."""
    if not rows:
        return
    ended = (each for each in records if each.status is not EpisodeStatus.MORE)
    numbers = {n for each in ended for n in range(each.episode, each.episode + each.count)}
    if rows["env_id"].any() or not numbers.issuperset(rows["episode"].tolist()):
        raise ConnectionRefusedByPeerError("It sent rejected rows of other episodes.")


def _numbers(record: EpisodeRecord) -> Index:
    """Return the number of the episode of each row of a record."""
    first = record.episode
    if record.count > 1:
        return np.arange(first, first + record.count)
    return np.full(record.rows, first)


def _check_fields(records: list[EpisodeRecord], peer: Peer) -> None:
    """Check the values of fields that episodes have once.

    Raises:
        NotFiniteError: If one is NaN or infinity.
    """
    for each in records:
        if each.fields:
            free = {field.name for field in peer.episode_fields if field.free_axis}
            block = {
                name: np.fromiter([value], object, 1) if name in free else value[None]
                for name, value in each.fields.items()
            }
            check_values({**block, "step": np.array([-1])}, peer.episode_fields, peer.instance_id)


def _parse_state(plain: Any) -> EpisodeState:
    """Return the state of an episode that a client sent."""
    kinds = [type(part) for part in plain] if isinstance(plain, tuple) else []
    if kinds != [int, int, bytes]:
        raise ConnectionRefusedByPeerError("It sent a state that is none.")
    return EpisodeState(*plain)


def _parse(plain: Any, fields: list[Field]) -> EpisodeRecord:
    """Return the record that a client described.

    Args:
        plain: What it sent.
        fields: The fields that each of its episodes has once.

    Raises:
        AttributeError, TypeError, ValueError, ConfigError: If there can be none such.
    """
    episode, count, rows, part, status, seconds, reason, values = plain
    if type(reason) is not str:
        raise TypeError("a reason is no text")
    known = EpisodeStatus(status)
    if known not in _STATUS:
        raise ValueError(f"the status {known.name}")
    wanted = fields if known is EpisodeStatus.FINISHED else []
    kinds = {name: (of.dtype.str, of.shape) for name, of in values.items()}
    if kinds.keys() != {field.name for field in wanted} or not all(
        kinds[field.name][0] == field.dtype and field.is_shape(kinds[field.name][1])
        for field in wanted
    ):
        raise ValueError(f"an episode with the fields {kinds!r:.200}")
    return EpisodeRecord(
        episode=episode,
        count=count,
        rows=rows,
        part=part,
        status=known,
        seconds=seconds,
        fields=values,
        reason=reason,
    )
