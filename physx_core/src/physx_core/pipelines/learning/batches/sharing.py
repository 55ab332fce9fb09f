"""SharedBatches: batches drawn by one process for several that learn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from physx_core.components.group import Group
from physx_core.dataset import Dataset
from physx_core.fields import Field
from physx_core.normalization import Normalization
from physx_core.pipelines.learning.batches.blocks import Block
from physx_core.pipelines.learning.batches.online import OnlineBatches
from physx_core.typing import Batch


class SharedBatches:
    """Gives each process of a group its share of the batches that the leading process draws.

    Attributes:
        block: Fields and normalization after the last block, without rows.
        number: Number of batches so far.
        weight: Weight of this process's share in the mean over the last batch.
        whole: The last batch, in the leading process; valid until the next one.
    """

    def __init__(self, group: Group, online: OnlineBatches | None, fields: Iterable[Field]) -> None:
        """Send the fields to all processes.

        Args:
            group: The processes.
            online: Draws the batches; None except in the leading process.
            fields: The environments' fields; empty except in the leading process.
        """
        self.number, self.weight = 0, 1.0
        self.whole: Batch = {}
        self._group, self._online = group, online
        told = group.broadcast([field.to_dict() for field in fields])
        self.block = _to_block({"fields": told, "normalization": {}})
        self._last: Block | None = None

    def next(self, names: Sequence[str]) -> Batch:
        """Return this process's share of the next batch.

        Args:
            names: Fields that a batch contains.

        Raises:
            PhysxError: In the leading process, if an environment fails, or rows cannot be stored.
        """
        changed = None
        if self._online is not None:
            batch = self._online.next(names)
            self.whole = {name: batch[name] for name in names if name in batch}
            block = self._online.block
            if self._last is None or block.rows:
                changed = _to_plain(block)
            self._last = block
        changed = self._group.broadcast(changed)
        if changed is not None:
            self.block = _to_block(changed)
        share, self.weight = self._group.scatter(self.whole)
        self.number += 1
        return share

    def finish(self, dataset: Dataset) -> None:
        """Make the stored rows visible to all processes, which read them from now on."""
        if self._online is not None:
            dataset.flush()
        self._group.broadcast(None)
        if self._online is None:
            dataset.refresh()


def _to_plain(block: Block) -> dict[str, Any]:
    return {
        "fields": [field.to_dict() for field in block.fields.values()],
        "normalization": {name: one.arrays() for name, one in block.normalization.items()},
    }


def _to_block(plain: dict[str, Any]) -> Block:
    fields = {one["name"]: Field.from_dict(one) for one in plain["fields"]}
    normalization = {
        name: Normalization.from_arrays(arrays, fields[name].entry_shape)
        for name, arrays in plain["normalization"].items()
    }
    return Block({}, fields, normalization)
