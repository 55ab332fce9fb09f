"""Pasts: what instances of streams need to go on in a later run, without repeating all rows.

That is the last state before some row, and what cannot be computed again after it: the predictions
that the instance has got since. `Pasts` collects this while the rows are generated, in the run's
process; a checkpoint keeps it, and `PastFiles` keeps it in a session.
"""

from __future__ import annotations

import logging
import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.closeable import Closeable
from physx_core.components.services import Services
from physx_core.errors import ConnectionRefusedByPeerError
from physx_core.net.values import decode, encode

LARGEST = 2**32
"""Maximum size of a file with pasts, in bytes."""
_PERIOD = 0.1
"""Time in s between two files of an instance."""
_SETTLED = 2.0
"""Time in s after which stored rows are on the disk: they are synced every second."""
_CHECKSUM = 4
_LOG = logging.getLogger("physx")

Answer = tuple[bool, bytes]
"""Whether a request for a prediction was answered, not refused; and the encoded answer or error."""


@dataclass(frozen=True)
class Past:
    """What an instance needs to go on.

    Attributes:
        rows: Number of rows that it had generated before the state.
        state: Its encoded state; empty: it begins anew, without having generated rows.
        rejected: How many of its samples `check_sample` had rejected before.
        recorded: Largest number of a set of parameters that was recorded for it before; -1: none.
        sets: Sets of parameters that it had been given, but were not recorded: values by number.
        saved: The parameters that it had saved.
        created: Answers to the requests for predictions before its first row.
        answers: Answers to those after the state, which may go on: only the first `count` belong to
            this past.
        count: See `answers`.
    """

    rows: int = 0
    state: bytes = b""
    rejected: int = 0
    recorded: int = -1
    sets: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    saved: Mapping[str, Any] = field(default_factory=dict)
    created: tuple[Answer, ...] = ()
    answers: list[Answer] = field(default_factory=list)
    count: int = 0

    @property
    def told(self) -> list[Answer]:
        """Answers that the instance gets again, in order."""
        return [*self.created, *self.answers[: self.count]]

    def pack(self) -> list[Any]:
        """Return it as plain values."""
        own = [self.rows, self.state, self.rejected, self.recorded, dict(self.sets)]
        return [*own, dict(self.saved), list(self.created), self.answers[: self.count]]

    @classmethod
    def unpack(cls, plain: Any) -> Past:
        """Return the past that `pack` returned.

        Raises:
            ValueError: If it is none.
        """
        kinds = [int, bytes, int, int, dict, dict, list, list]
        if not isinstance(plain, list) or [type(part) for part in plain] != kinds:
            raise ValueError("it is not the past of an instance")
        rows, state, rejected, recorded, sets, saved, created, answers = plain
        for each in (*created, *answers):
            if type(each) is not tuple or [type(part) for part in each] != [bool, bytes]:
                raise ValueError("an answer is not one")
        own = rows, state, rejected, recorded, sets, saved
        return cls(*own, tuple(created), answers, len(answers))


class Pasts:
    """The pasts of a run's instances, and what an earlier run has left of them."""

    def __init__(self, limit: float, former: Mapping[int, Past] | None = None) -> None:
        """Begin with what an earlier run has left.

        Args:
            limit: Largest number of bytes of an instance's answers between two states.
            former: The pasts by number of the instance.
        """
        self._limit, self._former = limit, dict(former or {})
        self._of: dict[int, _Growing] = {}
        self._told = {number: deque(past.told) for number, past in self._former.items()}

    def former(self, number: int) -> Past | None:
        """Return the past of an instance with which this run began."""
        return self._former.get(number)

    def tell(self, number: int) -> Answer | None:
        """Return what an earlier run answered to the instance's next request for a prediction."""
        told = self._told.get(number)
        if not told:
            return None
        answer = told.popleft()
        self.answered(number, answer)
        return answer

    def answered(self, number: int, answer: Answer) -> None:
        """Note the answer to a request for a prediction."""
        self._growing(number).add(answer)

    def created(self, number: int, services: Services) -> None:
        """Note that an instance is created; it then has the parameters that its past had saved.

        Further calls, for a client that takes the place of another one, do nothing.
        """
        former, is_first = self._former.get(number), self._growing(number).end_creation()
        if is_first and former is not None and former.saved:
            services.save_parameters(number, dict(former.saved))

    def note(self, number: int, past: Past) -> None:
        """Note a state; answers are added to it.

        Args:
            number: The instance.
            past: The state, without answers.
        """
        self._growing(number).begin(past)

    def at(self, rows_of: Callable[[int], int], count: int) -> dict[int, Past] | None:
        """Return the pasts of all instances, and forget what came before them.

        Args:
            rows_of: Returns how many rows an instance has generated.
            count: Number of instances.

        Returns:
            The newest past of each instance with no more than these rows; None: there are none, as
            one of them has got too large.
        """
        found = {n: self._growing(n).at(rows_of(n)) for n in range(1, count + 1)}
        whole = {n: past for n, past in found.items() if past is not None}
        return whole if len(whole) == count else None

    def _growing(self, number: int) -> _Growing:
        if number not in self._of:
            self._of[number] = _Growing(number, self._limit, self._former.get(number, Past()))
        return self._of[number]


class _Growing:
    """The past of one instance: states that may still be needed, each with the answers after it."""

    def __init__(self, number: int, limit: float, former: Past) -> None:
        self._number, self._limit, self._nbytes = number, limit, 0
        self._answers: list[Answer] = []
        self._created: tuple[Answer, ...] | None = None
        self._states = deque([replace(former, created=(), answers=self._answers, count=0)])
        self._is_given_up = False

    def add(self, answer: Answer) -> None:
        if self._is_given_up:
            return
        self._answers.append(answer)
        self._nbytes += len(answer[1])
        if self._nbytes > self._limit:
            self._is_given_up = True
            self._states.clear()
            self._answers = []
            _LOG.warning(
                "The training cannot be resumed within this epoch: the predictions for instance "
                "%d since its last state have more than EnvironmentConfig.journal_size = %g GB. "
                "Take states more often (state_every).",
                self._number,
                self._limit / 1e9,
            )

    def end_creation(self) -> bool:
        is_first = self._created is None
        if is_first:
            self._created = tuple(self._answers)
            self._answers.clear()
            self._nbytes = 0
        return is_first

    def begin(self, past: Past) -> None:
        if not self._is_given_up and past.rows > self._states[-1].rows:
            self._answers, self._nbytes = [], 0
            self._states.append(replace(past, answers=self._answers))

    def at(self, rows: int) -> Past | None:
        if self._is_given_up:
            return None
        while len(self._states) > 1 and self._states[1].rows <= rows:
            self._states.popleft()
        found, created = self._states[0], self._created or ()
        return replace(found, created=created, count=len(found.answers))


def pack(rows: int, pasts: Mapping[int, Past]) -> bytes:
    """Return the content of a checkpoint's file.

    Args:
        rows: Number of rows that all instances together had generated.
        pasts: Their pasts.
    """
    return encode([rows, {number: past.pack() for number, past in pasts.items()}], "the states")


def unpack(content: bytes) -> tuple[int, dict[int, Past]]:
    """Return what `pack` got.

    Raises:
        ValueError: If it is something else.
    """
    try:
        rows, plain = decode(content)
        return int(rows), {int(number): Past.unpack(past) for number, past in plain.items()}
    except (ConnectionRefusedByPeerError, TypeError, AttributeError) as error:
        raise ValueError(str(error)) from error


class PastFiles(Closeable):
    """Keeps the pasts of a generation in a session's folder: the last ones of each instance.

    The newest is replaced as soon as the rows before it are stored, which may not have reached the
    disk when the power fails. So two that were taken at least two seconds before they were written
    are kept beside it, replaced in turn. Each counts only if all that came before it is stored.
    """

    def __init__(self, folder: Path, run: str, clock: Clock = SYSTEM_CLOCK) -> None:
        """Keep the arguments.

        Args:
            folder: The folder; it is created when there is something to keep.
            run: What the pasts belong to; those of others do not count.
            clock: Tells when what was written is on the disk.
        """
        self._folder, self._run, self._clock = folder, run, clock
        self._written: dict[int, tuple[int, float]] = {}  # rows, and when
        self._waiting: dict[int, Past] = {}
        self._aging: dict[int, tuple[bytes, float]] = {}  # content, and when it was taken
        self._turns: Counter[int] = Counter()

    def keep(self, pasts: Mapping[int, Past]) -> None:
        """Take pasts, and write those that are new and due.

        Args:
            pasts: By number of the instance; all that came before them is stored.

        Raises:
            DatasetError: If the disk is full or fails.
        """
        now = self._clock.monotonic()
        for number, past in pasts.items():
            rows, when = self._written.get(number, (0, -math.inf))
            if past.rows > rows:
                self._waiting[number] = past
                if now - when >= _PERIOD:
                    self._write(number, now)

    def close(self) -> None:
        """Write what is not due yet; the dataset must be closed, so that its rows are on the disk.

        Raises:
            DatasetError: If the disk is full or fails.
        """
        for number in [*self._waiting]:
            self._write(number, math.inf)

    def _write(self, number: int, now: float) -> None:
        past = self._waiting.pop(number)
        content = encode([self._run, replace(past, count=0).pack()], "the state")
        content = crc32(content).to_bytes(_CHECKSUM, "little") + content
        aging, taken = self._aging.setdefault(number, (content, now))
        with files.storing(f"The state of instance {number}"):
            if not self._folder.is_dir():
                files.make_folder(self._folder)
            files.replace(self._folder / f"{number}.bin", content, wait=now == math.inf)
            if now - taken >= _SETTLED:
                self._turns[number] += 1
                name = f"{number}.{self._turns[number] % 2}.bin"
                files.replace(self._folder / name, aging, wait=False)
                self._aging[number] = content, now
        self._written[number] = past.rows, now

    def read(self, is_valid: Callable[[int, Past], bool]) -> dict[int, Past]:
        """Return the newest valid past of each instance.

        Args:
            is_valid: Returns whether all that came before the past of an instance is stored.
        """
        found: dict[int, Past] = {}
        for number, past in self._read_all():
            if is_valid(number, past) and past.rows > found.get(number, Past()).rows:
                found[number] = past
        return found

    def clear(self) -> None:
        """Remove the pasts of an earlier generation."""
        with files.storing(f"{self._folder}"):
            if self._folder.is_dir():
                files.remove_folder(self._folder)

    def _read_all(self) -> Iterator[tuple[int, Past]]:
        for path in self._folder.glob("*.bin"):
            try:
                number = int(path.name.partition(".")[0])
                content = files.read_content(path, LARGEST)
                if crc32(content[_CHECKSUM:]) != int.from_bytes(content[:_CHECKSUM], "little"):
                    continue  # it did not reach the disk
                run, plain = decode(content[_CHECKSUM:])
                past = Past.unpack(plain)
            except (OSError, ValueError, TypeError, ConnectionRefusedByPeerError):
                continue
            if run == self._run:
                yield number, past
