"""ReplayedBatches: stored samples that go through environments before they are trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from physx_core.dataset.store.definitions import compare_fields
from physx_core.fields import RESERVED, Field
from physx_core.normalization import Normalization
from physx_core.pipelines.learning.batches.stored import StoredBatches
from physx_core.pipelines.storage import record_beside_rows
from physx_core.pipelines.stored_rows import StoredRows
from physx_core.sources.source import Source
from physx_core.typing import Batch


class ReplayedBatches:
    """Sends the stored samples through environments and replaces them with the results.

    Attributes:
        source: The environments.
    """

    def __init__(
        self, source: Source, stored: StoredBatches, *, batch_size: int, seed: int | None
    ) -> None:
        """Check that the stored samples have the environments' fields.

        Args:
            source: The open environments.
            stored: The samples.
            batch_size: Samples in a batch; fewer at the end of a pass.
            seed: Seed of the order of each pass; None: the order of writing.

        Raises:
            DatasetError: If there are no samples.
            FieldsMismatchError: If their fields differ.
        """
        self.source = source
        self._stored, self._batch_size = stored, batch_size
        random = None if seed is None else np.random.default_rng([seed, 1])
        self._rows = StoredRows(stored.dataset, stored.mode, stored.rows, random)
        known, given = (
            {name: field for name, field in fields.items() if name not in RESERVED}
            for fields in (stored.fields, {field.name: field for field in source.fields})
        )
        compare_fields(f'The environment cannot replay mode "{stored.mode}", which', known, given)

    def begin_epoch(self, names: Sequence[str], batches: int) -> None:
        """Prepare an epoch; there is nothing to do."""

    def next(self) -> Batch:
        """Return the environments' results for the next samples, in physical units."""
        with record_beside_rows(self.source, self._stored.dataset, self._stored.mode):
            index, rows = self._rows.take(self._batch_size)
            batch = self.source.batch(len(index), rows)
            made = {name: values for name, values in batch.items() if name not in RESERVED}
            self._stored.update(index, made)
        return batch

    @property
    def fields(self) -> Mapping[str, Field]:
        """The stored fields by name."""
        return self._stored.fields

    def normalization(self) -> dict[str, Normalization]:
        """Return the normalization of the stored samples by field."""
        return self._stored.normalization()

    def finish(self) -> None:
        """End the last epoch; there is nothing to do."""
