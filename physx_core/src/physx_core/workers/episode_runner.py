"""EpisodeRunner: simulates the episodes of a campaign by number, and collects their rows."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.errors import (
    EnvironmentFailedError,
    NotFiniteError,
    PhysxError,
    ProgramError,
    WrongSamplesError,
)
from physx_core.fields import Field
from physx_core.rows import ROW_FIELDS, RowBuffer, infer_shapes
from physx_core.typing import Batch
from physx_core.workers.instance import Instance

OF_EPISODES = (EnvironmentFailedError, ProgramError, NotFiniteError, WrongSamplesError)
"""Errors that end an episode; others end the run."""
_BLOCK_TIME = 20e-3


class EpisodeBlock(NamedTuple):
    """Rows of episodes, and what is recorded of these.

    Attributes:
        rows: Field name to array of shape (n, *field shape), valid until the next block; of no
            fields if there are no rows.
        records: The episodes, or parts of them, that the rows belong to, in order.
        instance_id: The instance that has simulated them.
    """

    rows: Batch
    records: list[EpisodeRecord]
    instance_id: int = 1


@dataclass(slots=True)
class _Part:
    """A part of an episode, or several episodes of one row."""

    episode: int
    rows: int
    seconds: float
    part: int = 0
    count: int = 1
    status: EpisodeStatus = EpisodeStatus.FINISHED
    reason: str = ""


class EpisodeRunner:
    """Simulates one number after another with an instance.

    Rows get the episode's number as ``episode``, their number in it as ``step``, and 0 as
    ``env_id``: they do not depend on the instance.

    Attributes:
        fields: Fields of the rows; shapes may be open before the first one.
        failures: The errors of the episodes that failed, in order.
    """

    def __init__(
        self, instance: Instance, take: Callable[[], int | None], clock: Clock = SYSTEM_CLOCK
    ) -> None:
        """Store what simulates.

        Args:
            instance: Simulates the episodes; open.
            take: Returns the next number; None: there is none now.
            clock: Tells what an episode costs.
        """
        self.fields: list[Field] = [*instance.fields, *ROW_FIELDS]
        self.failures: list[PhysxError] = []
        self._instance, self._take, self._clock = instance, take, clock
        self._joins = not instance.parameters  # one record may stand for several episodes
        self._buffer: RowBuffer | None = None
        self._parts: list[_Part] = []
        self._again: deque[int] = deque()
        self._number: int | None = None  # of the episode that is being simulated
        self._part = self._step = 0
        self._first = 0  # row of the buffer with which its part begins
        self._began = 0.0

    @property
    def is_busy(self) -> bool:
        """Whether it goes on with numbers that it has taken."""
        return self._number is not None or bool(self._again)

    def run(self) -> EpisodeBlock:
        """Simulate until rows fill a block, episodes took 20 ms, or no number is left.

        Raises:
            PhysxError: If the environment fails in a way that concerns all episodes.
        """
        until = self._clock.monotonic() + _BLOCK_TIME
        while self._number is not None or self._begin():
            try:
                self._advance()
            except OF_EPISODES as error:
                self._fail(error)
            if self._number is None and self._began >= until:
                break
            if self._buffer is not None and self._buffer.full:
                break
        if self._number is not None:
            self._end(EpisodeStatus.MORE)
        return self._take_block()

    def _begin(self) -> bool:
        """Take the next number; return whether there is one."""
        number = self._again.popleft() if self._again else self._take()
        if number is None:
            return False
        self._number, self._part, self._step = number, 0, -1
        self._began = self._clock.monotonic()
        return True

    def _advance(self) -> None:
        """Begin the episode, or simulate its next row."""
        assert self._number is not None
        if self._step < 0:
            self._step = 0
            self._instance.begin(self._number)
        sample = self._instance.step()
        if sample:
            self._put(sample)
        if not sample or self._instance.has_ended:
            self._end(EpisodeStatus.FINISHED)
            self._number = None

    def _put(self, sample: dict[str, Any]) -> None:
        if self._buffer is None:
            self._buffer = RowBuffer(infer_shapes(self._instance.fields, sample))
            self.fields = self._buffer.fields
        self._buffer.put(sample, 0, self._number or 0, self._step)
        self._step += 1

    def _end(self, status: EpisodeStatus) -> None:
        """Note the rows of the episode since its last part, which ends with this status."""
        end = 0 if self._buffer is None else self._buffer.count
        rows, self._first = end - self._first, end
        seconds, self._began = self._clock.monotonic() - self._began, self._clock.monotonic()
        assert self._number is not None
        part = _Part(self._number, rows, seconds, self._part, status=status)
        last = self._parts[-1] if self._parts else None
        if last is not None and self._joins and _follows(part, last):
            last.count, last.rows, last.seconds = (
                last.count + 1,
                last.rows + 1,
                last.seconds + seconds,
            )
        else:
            self._parts.append(part)
        self._part += 1

    def _fail(self, error: PhysxError) -> None:
        """Note that the episode has failed, without its rows."""
        assert self._number is not None
        number, self._number = self._number, None
        if self._buffer is not None:
            self._buffer.count = self._first
        self._note_failure(number, error)

    def _note_failure(self, number: int, error: PhysxError) -> None:
        seconds = self._clock.monotonic() - self._began
        failed = _Part(number, 0, seconds, status=EpisodeStatus.FAILED, reason=str(error))
        self._parts.append(failed)
        self.failures.append(error)

    def _take_block(self) -> EpisodeBlock:
        rows: Batch = {}
        if self._buffer is not None and self._buffer.count:
            try:
                rows = self._buffer.take()
            except NotFiniteError as error:
                self._leave_out(self._buffer.count, error)
                rows = self._buffer.take() if self._buffer.count else {}
        parts, self._parts, self._first = self._parts, [], 0
        return EpisodeBlock(rows, [_record(part) for part in parts])

    def _leave_out(self, row: int, error: PhysxError) -> None:
        """Note that the episode of an invalid row has failed; simulate those after it once more."""
        start, kept = 0, list[_Part]()
        parts = iter(self._parts)
        for part in parts:
            if start + part.rows > row:
                break
            start += part.rows
            kept.append(part)
        good = row - start if part.count > 1 else 0
        number = part.episode + good
        if good:
            kept.append(_Part(part.episode, good, part.seconds, count=good))
        numbers = list(range(number + 1, part.episode + part.count))
        for later in parts:
            if later.status is EpisodeStatus.FAILED:
                kept.append(later)
            else:
                numbers += range(later.episode, later.episode + later.count)
        assert self._buffer is not None
        self._buffer.count = start + good
        self._parts, self._number = kept, None
        self._again.extend(numbers)
        self._note_failure(number, error)


def _follows(part: _Part, last: _Part) -> bool:
    """Return whether an episode of one row can be added to a part, as the next number."""
    finished = part.status is last.status is EpisodeStatus.FINISHED
    single = part.rows == 1 and not part.part and last.rows == last.count and not last.part
    return finished and single and last.episode + last.count == part.episode


def _record(part: _Part) -> EpisodeRecord:
    return EpisodeRecord(
        episode=part.episode,
        rows=part.rows,
        count=part.count,
        part=part.part,
        status=part.status,
        seconds=part.seconds,
        reason=part.reason,
    )
