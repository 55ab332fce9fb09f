"""OnlineBatches: a training's batches while environments generate the rows."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from physx_core.components.buffer import Buffer
from physx_core.dataset import Dataset
from physx_core.errors import CheckpointError
from physx_core.fields import Field
from physx_core.pipelines.learning.batches.blocks import Block, Blocks
from physx_core.pipelines.learning.batches.drawn_rows import DrawnRows
from physx_core.pipelines.learning.batches.row_store import RowStore
from physx_core.typing import Batch, Index
from physx_core.workers.pasts import Past, pack

_INTERVAL = 1.0
_LARGEST = 1024


class OnlineBatches:
    """For each batch, takes as many rows as the buffer needs, and draws the batch from the buffer.

    Attributes:
        block: The last block of rows.
        number: Number of batches drawn since the run began.
        rows: Indices of the last batch's rows, counted from the start of the run.
    """

    def __init__(
        self, blocks: Blocks, buffer: Buffer, data_type: str, drawn: DrawnRows | None, first: int
    ) -> None:
        """Start with the first batch.

        Args:
            blocks: The rows.
            buffer: Decides what batches contain; already started.
            data_type: Floating-point type of the batches of a buffer that keeps rows.
            drawn: Records the drawn rows.
            first: Index of the run's first row in the dataset.
        """
        self.block = Block()
        self.number = 0
        self.rows: Index = np.zeros(0, np.intp)
        self._blocks, self._buffer, self._data_type = blocks, buffer, data_type
        self._drawn, self._first = drawn, first
        self._store: RowStore | None = None
        self._arrived = 0
        self._pasts: dict[int, tuple[int, Mapping[int, Past]] | None] = {}
        self._meter = _Meter()
        self._summary: Mapping[str, float] = {}

    def next(self, names: Sequence[str]) -> Batch:
        """Return the next batch, in physical units; valid until the next call.

        Args:
            names: Fields that a batch contains if the buffer keeps rows; otherwise it contains all.

        Raises:
            PhysxError: If an environment fails, or rows cannot be stored.
        """
        count = self._buffer.needed(self.number) - self._arrived
        if self._buffer.capacity:
            batch = self._draw(count, names)
        else:
            batch = self._take(count)
            self.rows = np.arange(self._arrived, self._arrived + count)
        self._meter.count(count, self._blocks.waited)
        self._arrived += count
        self.number += 1
        before = self._pasts.get(self.number - 1)
        self._pasts = {self.number - 1: before, self.number: self.block.pasts}
        return batch

    def _take(self, size: int) -> Batch:
        """Return the rows of the next block."""
        with self._meter.waiting():
            self.block = self._blocks.next(size)
        self._summary = self.block.statistics or self._summary
        return self.block.rows

    def _draw(self, count: int, names: Sequence[str]) -> Batch:
        """Return a batch that the buffer draws after `count` rows have arrived."""
        draw, placed = self._buffer.take(self.number, count), 0
        for size in self._split(count):
            rows = self._take(size)
            if self._store is None:
                self._store = self._allocate(self.block.fields, names)
            if size:
                self._store.put(draw.placed[placed : placed + size], rows)
            placed += size
        assert self._store is not None
        self.rows = draw.rows
        if self._drawn is not None:
            self._drawn.append(self._first + draw.rows)
        return self._store.take(draw.drawn)

    def resume(
        self,
        number: int,
        state: Callable[[], Index],
        dataset: Dataset,
        mode: str,
        names: Sequence[str],
    ) -> None:
        """Continue after some batches, with the buffer in the state that it had then.

        The blocks continue there as well; the record of drawn rows was opened there.

        Args:
            number: Number of batches drawn, at least one.
            state: Returns the buffer's state at that time; called if it keeps rows.
            dataset: Contains the rows that had arrived by then.
            mode: Their mode.
            names: Fields that a batch contains if the buffer keeps rows.

        Raises:
            CheckpointError: If the state does not match this buffer.
        """
        buffer = self._buffer
        arrived = buffer.needed(number - 1)
        if buffer.capacity:
            self._restore(number, state())
            arrived = buffer.arrived
        self._blocks.skip(self._sizes(range(number), arrived))
        self.number, self._arrived = number, arrived
        self._pasts = {number: self._blocks.pasts}
        if buffer.capacity:
            self._store = self._allocate(dataset.fields(mode), names)
            slots = np.flatnonzero(buffer.rows >= 0)
            self._store.read(slots, dataset, mode, self._first + buffer.rows[slots])

    def _restore(self, number: int, state: Index) -> None:
        try:
            self._buffer.restore(number, state)
        except ValueError as error:
            raise CheckpointError(
                f"The training cannot be resumed: the state of its buffer does not match "
                f"{type(self._buffer).__name__}, because {error}. Resume with the same online, "
                "online_kwargs and batch_size."
            ) from error

    def expect(self, batches: int) -> None:
        """Announce that this many batches will be taken."""
        self._blocks.expect(self._sizes(range(self.number, self.number + batches)))

    def finish(self) -> None:
        """Leave out the rows that no batch needs: see `Blocks.finish`."""
        self._blocks.finish()

    def _sizes(self, batches: range, most: int | None = None) -> Iterator[int]:
        """Yield the sizes of the blocks for some batches, the next one first.

        Args:
            batches: Their numbers.
            most: Maximum number of rows that arrive, because a shorter run needed no more.
        """
        before = self._arrived
        for batch in batches:
            needed = self._buffer.needed(batch)
            needed = needed if most is None else min(needed, most)
            yield from self._split(needed - before)
            before = needed

    def _split(self, count: int) -> Iterator[int]:
        """Yield the sizes of the blocks in which rows for a batch arrive.

        The first batch may need many rows, which would take too much memory in one block.
        """
        largest = max(self._buffer.batch_size, _LARGEST)
        while self._buffer.capacity and count > largest:
            yield largest
            count -= largest
        yield count

    def state(self, batches: int) -> Index | None:
        """Return the buffer's state for a checkpoint; None: it keeps no rows.

        Args:
            batches: Number of batches already learned from: all, or all but the last one.
        """
        if not self._buffer.capacity:
            return None
        if self._drawn is not None:
            self._drawn.sync()
        return self._buffer.state(batches)

    def pasts(self, batches: int) -> bytes | None:
        """Return what streams need to go on, for a checkpoint; None: they repeat the rows.

        Args:
            batches: See `state`.
        """
        found = self._pasts.get(batches)
        return None if found is None else pack(*found)

    def recent_statistics(self) -> dict[str, float]:
        """Return statistics of the rows, the buffer, and the run's throughput, those that are due.

        ``fields/...`` are those of `RowStatistics`. The others are due once a second:
        ``online/rows_kept`` and ``online/mean_age`` describe the buffer, with the age in rows that
        arrived since; ``online/views`` is the average number of times that a row was used. The rest
        covers the time since the last call: ``online/rows_per_s``, ``online/batches_per_s``, and
        the fractions of it in which the network waited for rows, ``online/network_waits``, and the
        environments for the network, ``online/environments_wait``.
        """
        summary, self._summary = self._summary, {}
        rates = self._meter.read_recent()
        if not rates or not self._buffer.capacity:
            return {**summary, **rates}
        kept = self._buffer.kept
        return {
            **summary,
            "online/rows_kept": float(len(kept)),
            "online/mean_age": self._arrived - float(kept.mean()) if len(kept) else 0.0,
            "online/views": self._views,
            **rates,
        }

    def announce(self) -> Iterable[str]:
        """Return a line on what will be generated, if the buffer keeps rows."""
        buffer = self._buffer
        if buffer.capacity:
            yield (
                f"environments generate {buffer.total} samples; batches are drawn from up to "
                f"{buffer.capacity} of them, once there are {buffer.needed(0)}"
            )

    def describe(self) -> Iterable[str]:
        """Return a line on the epochs in which environments generated samples."""
        if self.number:
            total = self._meter.read()
            yield (
                f"while environments generated: {total['online/rows_per_s']:.4g} rows/s, "
                f"{total['online/batches_per_s']:.4g} batches/s, each row used {self._views:.2f} "
                f"times on average; the network waited {100 * total['online/network_waits']:.0f} % "
                f"of the time, the environments {100 * total['online/environments_wait']:.0f} %"
            )

    def _allocate(self, fields: Mapping[str, Field], names: Sequence[str]) -> RowStore:
        buffer = self._buffer
        return RowStore(buffer.capacity, buffer.batch_size, fields, names, self._data_type)

    @property
    def _views(self) -> float:
        return self.number * self._buffer.batch_size / max(1, self._arrived)


class _State(NamedTuple):
    time: float
    rows: int
    batches: int
    waited: float
    held_back: float


class _Meter:
    """A run's rates, and the times for which both sides waited."""

    def __init__(self) -> None:
        self._first = self._last = self._now = _State(time.monotonic(), 0, 0, 0.0, 0.0)

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Count the time of the body as waiting."""
        began = time.monotonic()
        if not self._now.batches:
            self._first = self._last = _State(began, 0, 0, 0.0, 0.0)
        yield
        ended = time.monotonic()
        self._now = self._now._replace(time=ended, waited=self._now.waited + ended - began)

    def count(self, rows: int, held_back: float | None) -> None:
        """Count a batch.

        Args:
            rows: Number of rows that arrived for it.
            held_back: Time in s for which the environments have waited so far; None: the time for
                which the network did not.
        """
        now = self._now
        if held_back is None:
            held_back = now.time - self._first.time - now.waited
        self._now = now._replace(rows=now.rows + rows, batches=now.batches + 1, held_back=held_back)

    def read_recent(self) -> dict[str, float]:
        """Return the rates since the last call; empty if that was less than a second ago."""
        if self._now.time < self._last.time + _INTERVAL:
            return {}
        last, self._last = self._last, self._now
        return self.read(last)

    def read(self, since: _State | None = None) -> dict[str, float]:
        """Return the rates since an earlier state; None: since the start."""
        now, before = self._now, since or self._first
        seconds = max(now.time - before.time, 1e-9)
        return {
            "online/rows_per_s": (now.rows - before.rows) / seconds,
            "online/batches_per_s": (now.batches - before.batches) / seconds,
            "online/network_waits": (now.waited - before.waited) / seconds,
            "online/environments_wait": (now.held_back - before.held_back) / seconds,
        }
