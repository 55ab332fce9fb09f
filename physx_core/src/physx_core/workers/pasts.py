"""Pasts: what instances of streams need to go on in a later run, without repeating all rows.

That is the last state before some row, and what cannot be computed again after it: the predictions
that the instance has got since. A `Journal` collects this while the rows are generated, in the
run's process; a checkpoint keeps it, and `PastFiles` keeps it in a session.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.closeable import Closeable
from physx_core.errors import ConnectionRefusedByPeerError
from physx_core.net.values import decode, encode

LARGEST = 2**32
"""Maximum size of a file with pasts, in bytes."""
_PERIOD = 0.1
"""Time in s between two files of an instance."""
_SETTLED = 2.0
"""Time in s after which stored rows are on the disk: they are synced every second."""
_CHECKSUM = 4

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


class Skip(NamedTuple):
    """What an earlier run with the same seed already got from the same instances.

    Attributes:
        rows: Number of rows from all instances together.
        rejected: Number of rejected samples of each instance; empty: none.
        sets: Numbers of the recorded sets of parameters.
        pasts: From where instances go on, by their number; the others repeat all of their rows.
    """

    rows: int = 0
    rejected: tuple[int, ...] = ()
    sets: frozenset[int] = frozenset()
    pasts: Mapping[int, Past] = {}

    def rows_of(self, number: int, instance_nb: int) -> int:
        """Return how many of the rows an instance generated; instances are numbered from 1."""
        return (self.rows - number + instance_nb) // instance_nb

    def rejected_of(self, number: int) -> int:
        """Return how many samples of an instance were rejected."""
        return self.rejected[number - 1] if self.rejected else 0

    def covers(self, number: int, past: Past, instance_nb: int) -> bool:
        """Return whether it has all that came before the past of an instance."""
        return (
            1 <= number <= instance_nb
            and past.rows <= self.rows_of(number, instance_nb)
            and past.rejected <= self.rejected_of(number)
            and (past.recorded < 0 or past.recorded in self.sets)
        )

    def repeated(self, instance_nb: int) -> int:
        """Return how many rows instances simulate again, all together."""
        known = sum(past.rows for past in self.pasts.values())
        return self.rows - known


NOTHING = Skip()
"""For a new run: there is no earlier one."""


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
            self._written.setdefault(number, (0, -math.inf))
            if is_valid(number, past) and past.rows > found.get(number, Past()).rows:
                found[number] = past
        return found

    def forget(self, numbers: range) -> None:
        """Remove what is kept of some numbers, which need it no more.

        Raises:
            DatasetError: If the disk fails.
        """
        for number in [each for each in self._written if each in numbers]:
            del self._written[number]
            for known in (self._waiting, self._aging, self._turns):
                known.pop(number, None)
            with files.storing(f"The state of number {number}"):
                for path in self._folder.glob(f"{number}.*bin"):
                    files.remove(path)

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
