"""TrainingSample: some of the samples that a network learned from, in memory, for its rivals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from physx_core.fields import free_axes
from physx_core.typing import Array, Batch, Index
from physx_core.views.batches import Batches

_ROWS = 10_000
_VALUES = 2**24  # float64: 128 MiB


class TrainingSample:
    """Samples from batches at equal distances in an epoch.

    Attributes:
        batch: The samples, field name to array of shape (rows, *field shape).
        groups: The trajectory of each, as a number, shape (rows,).
        is_packed: Whether free axes are packed, so that there are no `inputs` of equal sizes.
        inputs: What rivals read, shape (rows, columns): the network's inputs in one row, each
            column shifted to the mean 0 and scaled to the deviation 1.
    """

    def __init__(self, batches: Batches, given: Sequence[str]) -> None:
        """Read the samples.

        Args:
            batches: The batches of the training.
            given: Names of the network's inputs.
        """
        width = sum(int(np.prod(field.entry_shape)) for field in batches.fields.values())
        self.is_packed = bool(free_axes(batches.fields.values()))
        rows = max(1, min(_ROWS, _VALUES // max(1, width), batches.num_items))
        count = min(len(batches), -(-rows // batches.batch_size))
        chosen = np.unique(np.linspace(0, len(batches) - 1, count).astype(int)).tolist()
        parts = [{n: v.copy() for n, v in batches[number].items()} for number in chosen]
        names = list(parts[0])
        most = None if self.is_packed else rows
        self.batch: Batch = {n: np.concatenate([p[n] for p in parts])[:most] for n in names}
        self.groups: Index = np.concatenate([batches.groups(n) for n in chosen])[:rows]
        self._given = list(given)
        if self.is_packed:
            self.inputs = np.zeros((len(self.groups), 0))
            return
        self.inputs = self._flat(self.batch)
        self._mean, spread = self.inputs.mean(axis=0), self.inputs.std(axis=0)
        self._scale = np.where(spread > 0, spread, 1.0)
        self._standardize(self.inputs)

    def _flat(self, batch: Batch) -> Array:
        parts = []
        for name in self._given:
            values = batch[name].reshape(len(batch[name]), -1)
            is_complex = values.dtype.kind == "c"
            parts += [values.real, values.imag] if is_complex else [values]
        return np.concatenate(parts, axis=1, dtype=np.float64)

    def read(self, batch: Batch) -> Array:
        """Return what rivals read of a batch: see `inputs`."""
        return self._standardize(self._flat(batch))

    def _standardize(self, flat: Array) -> Array:
        flat -= self._mean
        flat /= self._scale
        return flat

    def split(self) -> tuple[Index, Index]:
        """Return the samples of four fifths of the trajectories, and the others.

        Of fewer than five trajectories, the others are the last samples.
        """
        known, place = np.unique(self.groups, return_inverse=True)
        back = place % 5 == 4
        if len(known) < 5:
            back = np.arange(len(place)) >= len(place) * 4 // 5
        return np.flatnonzero(~back), np.flatnonzero(back)
