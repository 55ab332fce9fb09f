"""Blocks: the rows that environments generate for a training, block by block."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from physx_core.dataset import Dataset
from physx_core.fields import Field
from physx_core.normalization import (
    Measured,
    Normalization,
    Normalize,
    compute_normalization,
    measured,
)
from physx_core.packing import join
from physx_core.pipelines.campaign_writer import CampaignWriter
from physx_core.pipelines.learning.batches.feeder import Feeder
from physx_core.pipelines.learning.batches.row_statistics import RowStatistics
from physx_core.pipelines.storage import last_steps, record_beside_rows, store_sets
from physx_core.rows import concatenate
from physx_core.sources.source import Source
from physx_core.statistics import RunningStatistics
from physx_core.typing import Batch
from physx_core.workers.pasts import Past, Skip

_CHUNK = 4096


@dataclass(frozen=True)
class Block:
    """Consecutive rows that environments generated; they are already stored.

    Attributes:
        rows: The rows, field name to array with a leading row axis, in physical units; valid until
            the next block is taken. Empty if the block has no rows.
        fields: The stored fields by name; empty before the first row.
        normalization: The normalization of all rows up to the last one of this block, by field;
            empty if nothing is to be normalized.
        statistics: Mean, deviation, and quantiles of the rows up to the last one of this block, if
            they are due: see `RowStatistics`.
        pasts: Number of rows up to its last one, and what streams need to go on after it; None:
            they would have to repeat these rows.
    """

    rows: Batch = field(default_factory=dict)
    fields: Mapping[str, Field] = field(default_factory=dict)
    normalization: dict[str, Normalization] = field(default_factory=dict)
    statistics: Mapping[str, float] = field(default_factory=dict)
    pasts: tuple[int, Mapping[int, Past]] | None = None

    @property
    def nbytes(self) -> int:
        """Size of the rows in memory."""
        return sum(array.nbytes for array in self.rows.values())


class Blocks:
    """Takes rows from environments in the order of their numbers, and stores them.

    Independent episodes are stored as they end, and their rows read in the order of the episodes.
    A run that continues another run first gets the rows that the other run stored, in the same
    blocks and with bit-identical normalization. If its environments go on from states before some
    of these rows, they generate those again.

    With a feeder, expected blocks are generated and stored in its thread while the network learns:
    the calls of source and dataset and their order are the same, and so are the blocks.
    """

    def __init__(
        self,
        source: Source,
        dataset: Dataset,
        mode: str,
        *,
        normalize: Normalize,
        first: int,
        known: Skip,
        statistics: RowStatistics,
        writer: CampaignWriter | None = None,
        feeder: Feeder[Block] | None = None,
    ) -> None:
        """Keep the arguments.

        Args:
            source: The open environments.
            dataset: Stores the rows.
            mode: Mode to store them in.
            normalize: Whether the blocks have a normalization, and which: see `DatasetConfig`.
            first: Number of rows that the mode had before the first block.
            known: The rows that the environments do not return.
            statistics: Summarizes the rows; still without any.
            writer: Stores independent episodes; None: the environments are streams.
            feeder: Generates rows in its thread, which is not started yet; None: the rows are
                generated when they are taken.
        """
        self._source, self._dataset, self._mode = source, dataset, mode
        self._normalize, self._summary = normalize, statistics
        self._writer, self._first = writer, first
        self._end = dataset.num_samples(mode)
        self._stored = first + known.rows if writer is None else self._end
        self._next_row = first
        self._statistics: dict[Measured, RunningStatistics] = {}
        for start in range(0, 0 if normalize is False else first, _CHUNK):
            self._add(self._read(start, min(start + _CHUNK, first)))
        self._earlier: dict[int, int] = {}
        if writer is None:
            count = source.instance_nb
            self._earlier = last_steps(dataset, mode, first, self._stored, count)
        pasts = (known.rows, known.pasts) if known.pasts else None
        self._last = Block(pasts=pasts)
        self._feeder = feeder
        if feeder is not None:
            feeder.start(lambda count: self._make(count, copies=True), source.cancel)

    @property
    def waited(self) -> float | None:
        """Time in s for which the environments waited; None: they wait while the network learns."""
        return None if self._feeder is None else self._feeder.waited

    def expect(self, counts: Iterable[int]) -> None:
        """Announce the sizes of the blocks to be taken after those already announced."""
        if self._feeder is not None:
            self._feeder.expect(counts)

    def next(self, count: int) -> Block:
        """Return the next rows, generated and stored.

        Args:
            count: Number of rows; 0 requests none from the environments.

        Raises:
            PhysxError: If an environment fails, or a row cannot be stored.
        """
        return self._make(count) if self._feeder is None else self._feeder.next(count)

    def skip(self, counts: Iterable[int]) -> None:
        """Skip the first blocks, which precede a checkpoint; no block may be expected yet.

        Args:
            counts: Their numbers of rows.
        """
        for count in counts:
            self._make(count)
        fields, pasts = self._dataset.fields(self._mode), self._last.pasts
        self._last = Block({}, fields, self._last.normalization, pasts=pasts)

    @property
    def pasts(self) -> tuple[int, Mapping[int, Past]] | None:
        """What streams need to go on after the blocks that were skipped: see `Block`."""
        return self._last.pasts

    def finish(self) -> None:
        """Leave out the rows of the last episodes that no block has taken."""
        if self._writer is not None:
            self._writer.cut(self._next_row - self._first)

    def close(self) -> None:
        """Stop generating; rows that were generated ahead are stored."""
        if self._feeder is not None:
            self._feeder.close()

    def _make(self, count: int, *, copies: bool = False) -> Block:
        if not count:
            last = self._last
            self._last = Block({}, last.fields, last.normalization, pasts=last.pasts)
            return self._last
        start, self._next_row = self._next_row, self._next_row + count
        rows = self._take(start, count, copies=copies)
        self._add(rows)
        fields, known = self._dataset.fields(self._mode), self._statistics.__getitem__
        found = compute_normalization(self._normalize, fields, fields, known)
        summary = self._summary.add(rows, _counted(fields))
        self._last = Block(rows, fields, found, summary, self._find_pasts())
        return self._last

    def _find_pasts(self) -> tuple[int, Mapping[int, Past]] | None:
        if self._next_row <= self._stored:  # environments have not yet told again what they knew
            return self._last.pasts
        pasts = self._source.take_pasts()
        return None if pasts is None else (self._next_row - self._first, pasts)

    def _take(self, start: int, count: int, *, copies: bool) -> Batch:
        """Return some rows, which are stored from now on at the latest."""
        if self._writer is not None:
            self._writer.store_rows(start + count - self._first)
            return self._read(start, start + count)
        stored = min(count, max(0, self._stored - start))
        rows = self._read(start, start + stored) if stored else {}
        if stored < count:
            made = self._generate(start + stored, count - stored, is_whole=not stored)
            if rows:
                return concatenate([rows, made])
            return {name: array.copy() for name, array in made.items()} if copies else made
        return rows

    def _generate(self, start: int, count: int, *, is_whole: bool) -> Batch:
        earlier, self._earlier = self._earlier if is_whole else {}, {}
        with record_beside_rows(self._source, self._dataset, self._mode, earlier):
            rows = self._source.batch(count)
            store_sets(self._source, self._dataset, self._mode)
            self._dataset.define_fields(self._mode, self._source.fields)
            self._store(start, rows, min(count, max(0, self._end - start)))
        return rows

    def _store(self, start: int, rows: Batch, known: int) -> None:
        """Store rows, of which an earlier run has stored the first ones."""
        if known:
            former, now = self._read(start, start + known), _part(rows, slice(known))
            if any(former[name].tobytes() != now[name].tobytes() for name in now):
                self._dataset.update(self._mode, slice(start, start + known), now)
        if known < len(rows["step"]):
            self._dataset.append(self._mode, _part(rows, slice(known, None)), checked=True)

    def _read(self, start: int, stop: int) -> Batch:
        view = self._dataset[self._mode]
        return {name: view[name][start:stop] for name in self._dataset.fields(self._mode)}

    def _add(self, rows: Batch) -> None:
        fields = self._dataset.fields(self._mode)
        entries = {n: join(of, rows[n].tolist())[0] for n, of in fields.items() if of.free_axis}
        for of in measured(self._normalize, fields):
            statistics = self._statistics.setdefault(of, RunningStatistics(of.pooled))
            statistics.update(of.of({**rows, **entries}))


def _part(rows: Batch, part: slice) -> Batch:
    return {name: values[part] for name, values in rows.items()}


def _counted(fields: Mapping[str, Field]) -> list[str]:
    return [name for name, of in fields.items() if of.has_statistics and not of.free_axis]
