"""EpisodeRunner: simulates the episodes of a campaign by number, and collects their rows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.errors import (
    EnvironmentFailedError,
    FieldShapeError,
    NotFiniteError,
    PhysxError,
    ProgramError,
    SampleError,
    StateError,
    WrongSamplesError,
)
from physx_core.fields import Field
from physx_core.net.values import decode, encode
from physx_core.rows import ROW_FIELDS, RowBuffer, infer_shapes
from physx_core.typing import Batch
from physx_core.workers.instance import MOST_REJECTED, Instance
from physx_core.workers.lease import AIM, Begun, EpisodeState, Lease

OF_EPISODES = (EnvironmentFailedError, ProgramError, NotFiniteError, WrongSamplesError)
"""Errors that end an episode."""
_FINISHED, _MORE = EpisodeStatus.FINISHED, EpisodeStatus.MORE  # looking members up takes long
_PART_TIME = 10.0  # s
_MOST_BYTES = 2**22  # of the fields of episodes in a block


class EpisodeBlock(NamedTuple):
    """Rows of episodes, and what is recorded of these.

    Attributes:
        rows: Field name to array of shape (n, *field shape), valid until the next block; of no
            fields if there are no rows.
        records: The episodes, or parts of them, that the rows belong to, in order.
        instance_id: The instance that has simulated them.
        rejected: The samples that `check_sample` rejected in the episodes that have ended, if they
            are recorded; ``step`` counts all of an episode's.
        first_row: Address of the rows if a client has written them itself, so that there are none.
        state: The newest state of the last episode, which goes on; None: there is no new one.
    """

    rows: Batch
    records: list[EpisodeRecord]
    instance_id: int = 1
    rejected: Batch = {}  # noqa: RUF012 - never changed
    first_row: int | None = None
    state: EpisodeState | None = None


@dataclass(slots=True)
class _Part:
    """A part of an episode, or several episodes of one row."""

    episode: int
    rows: int
    seconds: float
    part: int
    lease: Lease
    count: int = 1
    status: EpisodeStatus = EpisodeStatus.FINISHED
    reason: str = ""
    fields: Batch | None = None

    def some(self, first: int, count: int) -> _Part:
        """Return some of its episodes, counted from 0, which have one row each."""
        seconds = self.seconds * count / self.count
        return replace(self, episode=self.episode + first, rows=count, seconds=seconds, count=count)

    def failed(self, at: int, reason: str) -> _Part:
        """Return what is noted if one of its episodes, counted from 0, has failed."""
        seconds, status = self.seconds / self.count, EpisodeStatus.FAILED
        return _Part(self.episode + at, 0, seconds, 0, self.lease, status=status, reason=reason)


class EpisodeRunner:
    """Simulates one number after another with an instance.

    Rows get the episode's number as ``episode``, their number in it as ``step``, and 0 as
    ``env_id``: they do not depend on the instance.

    Attributes:
        fields: Fields of the rows; shapes may be open before the first one.
        is_busy: Whether it may go on with numbers that it has taken.
    """

    def __init__(
        self,
        instance: Instance,
        take: Callable[[], Lease | None],
        refuse: Callable[[StateError], None],
        *,
        state_every: int = 0,
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        """Store what simulates.

        Args:
            instance: Simulates the episodes; open.
            take: Returns the next numbers; None: there are none now.
            refuse: Called once if an episode cannot give a state, or go on from one.
            state_every: Number of rows after which an episode gives a state; 0: never.
            clock: Tells what an episode costs.
        """
        self.fields: list[Field] = [*instance.fields, *ROW_FIELDS]
        self.is_busy = False
        self._instance, self._take, self._now = instance, take, clock.monotonic
        self._refuse, self._has_refused, self._state_every = refuse, False, state_every
        self._state: EpisodeState | None = None
        self._lease = Lease(range(0), {})
        self._episodes = self._lease.episodes()
        self._number: int | None = None  # of the episode that is being simulated
        self._part = self._step = self._stored = 0  # rows that an earlier client has stored
        self._buffer: RowBuffer | None = None
        self._parts: list[_Part] = []
        self._joined: _Part | None = None  # the last part, if an episode of one row can be added
        self._first = 0  # row of the buffer with which the episode's part begins
        self._began = 0.0
        self._makes_single_rows = instance.makes_single_rows
        self._episode_fields = {field.name for field in instance.episode_fields}
        nbytes = sum(field.nbytes for field in instance.episode_fields)
        self._most_parts = _MOST_BYTES / nbytes if nbytes else math.inf

    def run(self) -> EpisodeBlock:
        """Simulate until rows fill a block, episodes took 20 ms, or no number is left.

        A part of a long episode is returned after 10 s, so that it is on the disk, and with each
        state.

        Raises:
            PhysxError: If the environment fails in a way that concerns all episodes.
        """
        self._began = self._now()
        until = self._began + AIM
        while True:
            try:
                if self._number is None and not self._begin():
                    break
                self._make_row()
                if self._makes_single_rows and self._number is None:
                    self._make_single_rows(until)
            except PhysxError as error:
                if not self._concerns_one(error):
                    error.add_note(f"in {self._described()}")
                    raise
                self._fail(error)
            if self._number is None and self._began >= until:
                break
            if self._is_full or (self._number is not None and self._is_due):
                break
        if self._number is not None:
            self._end(_MORE)
        return self._take_block()

    @property
    def _is_full(self) -> bool:
        """Whether the block can take no further rows, or no further episodes."""
        if self._buffer is not None and self._buffer.full:
            return True
        rejected = len(self._instance.rejected or ())
        has_many = len(self._parts) >= self._most_parts or rejected >= MOST_REJECTED
        return self._number is None and has_many

    @property
    def _is_due(self) -> bool:
        """Whether the rows of an episode that goes on are to be stored now."""
        if self._step <= self._stored:
            return False
        return self._now() - self._began >= (AIM if self._state else _PART_TIME)

    def _begin(self) -> bool:
        """Begin the next number; return whether there is one."""
        following = next(self._episodes, None) or self._take_more()
        if following is None:
            return False
        self._number, values = following
        self._part = self._step = self._stored = 0
        self._state = None
        self._instance.begin(self._number, values)
        if self._lease.begun is not None:
            self._go_on(self._lease.begun)
        return True

    def _go_on(self, begun: Begun) -> None:
        """Go on with an episode from its state; if that is impossible, it has begun anew."""
        try:
            self._instance.set_state(decode(begun.state))
        except StateError as error:
            self._say_refusal(error)
        else:
            self._part, self._stored, self._step, _ = begun

    def _take_state(self) -> None:
        """Take the state of an episode, always after the same rows: see `Instance.get_state`."""
        try:
            state = encode(self._instance.get_state(), "the state")
        except StateError as error:
            self._say_refusal(error)
        else:
            self._state = EpisodeState(self._number or 0, self._step, state)

    def _say_refusal(self, error: StateError) -> None:
        if not self._has_refused:
            self._has_refused = True
            self._refuse(error)

    def _take_more(self) -> tuple[int, Mapping[str, Any]] | None:
        """Take numbers and return the first one with its parameters; None if there are none."""
        lease = self._take()
        self.is_busy, self._joined = lease is not None, None
        if lease is None:
            return None
        self._lease, self._episodes = lease, lease.episodes()
        return next(self._episodes)

    def _make_row(self) -> None:
        """Simulate the next row of the episode, which may be its last."""
        sample = self._instance.step()
        if sample:
            if self._step >= self._stored:
                buffer = self._buffer or self._make_buffer(sample)
                buffer.put(sample, 0, self._number or 0, self._step)
            self._step += 1
        if not sample or self._instance.has_ended:
            fields = self._instance.take_episode_data() if self._episode_fields else None
            self._end(_FINISHED, fields=fields)
            self._number = None
        elif self._state_every and self._step % self._state_every == 0:
            self._take_state()

    def _make_single_rows(self, until: float) -> None:
        """Simulate episodes of one row while there are numbers, space, and time."""
        buffer = self._buffer
        if buffer is None or buffer.full or self._began >= until:
            return
        put, now, start, first = buffer.put, self._now, buffer.count, self._instance.episode + 1
        sample: Mapping[str, Any] | None = None
        try:
            following = itertools.islice(self._episodes, buffer.capacity - start)
            for sample in self._instance.single_rows(following):
                if not sample:
                    break
                put(sample, 0, None, 0)
                if now() >= until:
                    break
        finally:
            if count := buffer.count - start:
                buffer.number_rows(start, first)
                self._number, self._part = first, 0
                self._end(_FINISHED, count)
            has_ended = self._instance.episode < first + count
            self._number, self._part = None if has_ended else first + count, 0
        if not has_ended:  # without a row
            self._end(_FINISHED)
            self._number = None

    def _make_buffer(self, sample: dict[str, Any]) -> RowBuffer:
        buffer = self._buffer = RowBuffer(infer_shapes(self._instance.fields, sample))
        self.fields = buffer.fields
        return buffer

    def _end(self, status: EpisodeStatus, count: int = 1, fields: Batch | None = None) -> None:
        """Note the rows of the episode since its last part, which ends with this status.

        Args:
            status: The status.
            count: Number of episodes, of one row each if they are several.
            fields: What the episode has once, if there is such; then it has a record of its own.
        """
        end = 0 if self._buffer is None else self._buffer.count
        rows, self._first = end - self._first, end
        now = self._now()
        seconds, self._began = now - self._began, now
        is_single = rows == count and not (self._part or fields) and status is _FINISHED
        joined = self._joined
        if is_single and joined is not None:
            joined.count += count
            joined.rows += rows
            joined.seconds += seconds
            return
        assert self._number is not None
        part = _Part(
            self._number, rows, seconds, self._part, self._lease, count, status, fields=fields
        )
        self._parts.append(part)
        self._joined = part if is_single else None
        self._part += 1

    def _concerns_one(self, error: PhysxError) -> bool:
        """Return whether an error ends its episode; others end the run.

        What has another shape than an earlier episode's may be right, if the field has none.
        """
        if isinstance(error, SampleError) and error.field in self._episode_fields:
            return True
        if isinstance(error, FieldShapeError):
            fields = self._instance.fields
            return any(f.name == error.field and f.shape is not None for f in fields)
        return isinstance(error, OF_EPISODES)

    def _described(self) -> str:
        """Return the number of the episode and its first parameters, for an error."""
        number = self._number or 0
        values = self._lease.parameters(number, 1).items()
        texts = [f"{name} = {value}" for name, value in values if not np.ndim(value)]
        return f"episode {number}" + (f", with {', '.join(texts[:8])}" if texts else "")

    def _fail(self, error: PhysxError) -> None:
        """Note that the episode has failed, without its rows."""
        if self._buffer is not None:
            self._buffer.count = self._first
        self._part = 0
        self._end(EpisodeStatus.FAILED)
        self._parts[-1].reason, self._number = _reason(error), None

    def _take_block(self) -> EpisodeBlock:
        rows: Batch = {}
        while not rows and self._buffer is not None and (count := self._buffer.count):
            try:
                rows = self._buffer.take()
            except NotFiniteError as error:
                self._leave_out(self._buffer, self._buffer.count, count, str(error))
        parts, self._parts, self._first, self._joined = self._parts, [], 0, None
        records, who = [_record(part) for part in parts], self._instance.instance_id
        state, self._state = None if self._number is None else self._state, None
        return EpisodeBlock(rows, records, who, self._take_rejected(), state=state)

    def _take_rejected(self) -> Batch:
        """Return the rejected samples of all episodes but the one that goes on."""
        rejected = self._instance.rejected
        if not rejected:
            return {}
        if self._buffer is None:
            self.fields = [*rejected.infer_shapes(self._instance.fields), *ROW_FIELDS]
        rows = rejected.take(self.fields[: -len(ROW_FIELDS)], 0, self._number)
        return rows if len(rows["step"]) else {}

    def _leave_out(self, buffer: RowBuffer, row: int, count: int, reason: str) -> None:
        """Note that the episode of an invalid row, of `count`, has failed, without its rows."""
        start, place = 0, 0
        while start + self._parts[place].rows <= row:
            start += self._parts[place].rows
            place += 1
        part = self._parts[place]
        good = row - start if part.count > 1 else 0
        found = [part.failed(good, reason)]
        if good:
            found.insert(0, part.some(0, good))
        if good + 1 < part.count:
            found.append(part.some(good + 1, part.count - good - 1))
        self._parts[place : place + 1] = found
        if part.status is EpisodeStatus.MORE:
            self._number = None
        buffer.remove(start + good, 1 if part.count > 1 else part.rows, count)


def _reason(error: PhysxError) -> str:
    """Return why an episode failed, whichever instance has simulated it, and then where."""
    if not isinstance(error, EnvironmentFailedError):
        return str(error)
    at = f" at step {error.step}" if error.step >= 0 else ""
    return f"{error.method}(){at}: {error.summary}\n{error.remote_traceback}"


def _record(part: _Part) -> EpisodeRecord:
    return EpisodeRecord(
        episode=part.episode,
        rows=part.rows,
        count=part.count,
        part=part.part,
        status=part.status,
        seconds=part.seconds,
        parameters=part.lease.parameters(part.episode, part.count),
        fields=part.fields or {},
        reason=part.reason,
    )
