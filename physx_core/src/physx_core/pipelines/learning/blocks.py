"""Blocks: the rows that environments generate for a training, block by block."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from physx_core.dataset import Dataset
from physx_core.fields import Field
from physx_core.pipelines.learning.feeder import Feeder
from physx_core.pipelines.storage import record_rejected
from physx_core.sources.source import Source
from physx_core.statistics import Normalization
from physx_core.typing import Batch


@dataclass(frozen=True)
class Block:
    """Consecutive rows that environments generated; they are stored already.

    Attributes:
        rows: The rows, field name to array with a leading row axis, in physical units; valid until
            the next block is taken. Empty if the block has no rows.
        fields: The stored fields by name; empty before the first row.
        normalization: The normalization of all rows up to the last one of this block, by field;
            empty if nothing is to be normalized.
    """

    rows: Batch = field(default_factory=dict)
    fields: Mapping[str, Field] = field(default_factory=dict)
    normalization: dict[str, Normalization] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Size of the rows in memory."""
        return sum(array.nbytes for array in self.rows.values())


class Blocks:
    """Takes rows from environments in the order of their numbers, and stores them.

    With a feeder, blocks that are expected are generated and stored in its thread while the
    training learns: the same calls of source and dataset in the same order, so the same blocks.
    """

    def __init__(
        self,
        source: Source,
        dataset: Dataset,
        mode: str,
        *,
        normalize: bool,
        feeder: Feeder[Block] | None = None,
    ) -> None:
        """Keep the arguments.

        Args:
            source: The environments; open.
            dataset: Stores the rows.
            mode: Mode to store them in.
            normalize: Whether the blocks have a normalization.
            feeder: Has a thread for it, not started yet; None: the rows are generated when they
                are taken.
        """
        self._source, self._dataset, self._mode = source, dataset, mode
        self._normalizes = normalize
        self._last = Block()
        self._feeder = feeder
        if feeder is not None:
            feeder.start(lambda count: self._make(count, copies=True), source.cancel)

    @property
    def waited(self) -> float | None:
        """Time in s for which the environments waited; None: whenever the network learns."""
        return None if self._feeder is None else self._feeder.waited

    def expect(self, counts: Iterable[int]) -> None:
        """Announce the sizes of the blocks that will be taken after those announced before."""
        if self._feeder is not None:
            self._feeder.expect(counts)

    def next(self, count: int) -> Block:
        """Return the next rows, generated and stored.

        Args:
            count: Number of rows; with 0 no environment is asked for any.

        Raises:
            PhysxError: If an environment fails, or a row cannot be stored.
        """
        return self._make(count) if self._feeder is None else self._feeder.next(count)

    def close(self) -> None:
        """Generate nothing more; rows that were generated ahead are stored."""
        if self._feeder is not None:
            self._feeder.close()

    def _make(self, count: int, *, copies: bool = False) -> Block:
        rows: Batch = {}
        if count:
            with record_rejected(self._source, self._dataset):
                rows = self._source.batch(count)
                self._dataset.define_fields(self._mode, self._source.fields)
                self._dataset.append(self._mode, rows, checked=True)
                if copies:
                    rows = {name: array.copy() for name, array in rows.items()}
        self._last = self._describe(rows)
        return self._last

    def _describe(self, rows: Batch) -> Block:
        if not rows:
            return Block({}, self._last.fields, self._last.normalization)
        normalization = self._dataset.normalization_of(self._mode) if self._normalizes else {}
        return Block(rows, self._dataset.fields(self._mode), normalization)
