"""GeneratedBatches: batches of samples that environments generate during training."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from physx_core import checkpoint
from physx_core.components.group import Group
from physx_core.errors import CheckpointError
from physx_core.fields import Field
from physx_core.normalization import Normalization
from physx_core.pipelines.learning.batches.online import OnlineBatches
from physx_core.pipelines.learning.batches.sharing import SharedBatches
from physx_core.pipelines.learning.batches.stored import StoredBatches
from physx_core.sources.source import Source
from physx_core.typing import Array, Batch, Index


class GeneratedBatches:
    """Batches of samples that environments generate, stored before they are trained on.

    In a group of processes, only the leading one has the environments; each process gets its share.

    Attributes:
        source: The environments; None except in the leading process.
        online: Draws the batches; None except in the leading process.
        repeats: Returns whether the environments would generate the same samples again.
        learns: Whether a sampler learns from the row losses.
    """

    def __init__(
        self,
        stored: StoredBatches,
        source: Source | None,
        online: OnlineBatches | None,
        group: Group,
        *,
        ahead: bool,
        repeats: Callable[[], bool],
    ) -> None:
        """Keep the arguments.

        Args:
            stored: The samples of earlier runs, and from now on the generated samples.
            source: The open environments; None except in the leading process.
            online: Draws batches of the generated samples; None except in the leading process.
            group: The processes that train together.
            ahead: Whether all batches of an epoch will be taken, and so may be generated ahead.
            repeats: Returns whether the environments would generate the same samples again.
        """
        self.source, self.online = source, online
        self._stored, self._group, self._ahead, self.repeats = stored, group, ahead, repeats
        self._names: Sequence[str] = ()
        self._shared: SharedBatches | None = None
        self.learns: bool = group.broadcast(source is not None and source.sets.learned is not None)
        if group.size > 1:
            self._shared = SharedBatches(group, online, source.fields if source else ())

    def begin_epoch(self, names: Sequence[str], batches: int) -> None:
        """Prepare an epoch.

        Args:
            names: Fields of the batches, for a buffer that keeps rows.
            batches: Number of batches that will be taken.
        """
        self._names = names
        if self.online is not None and self._ahead:
            self.online.expect(batches)

    def next(self) -> Batch:
        """Return the next batch, or this process's share of it, in physical units.

        Raises:
            PhysxError: In the leading process, if an environment fails, or rows cannot be stored.
        """
        names = self._drawn_fields(self._names)
        if self._shared is not None:
            return self._shared.next(names)
        assert self.online is not None
        return self.online.next(names)

    def _drawn_fields(self, names: Sequence[str]) -> Sequence[str]:
        """Return the fields of drawn batches, with the number of the episode for the sampler."""
        return [*names, "episode"] if self.learns else names

    @property
    def weight(self) -> float | None:
        """Weight of the last batch if it is this process's share; None: it is a whole batch."""
        return None if self._shared is None else self._shared.weight

    def tell(self, batch: Batch, losses: Array) -> None:
        """Pass the last batch's losses to the sampler, which learns from them.

        Args:
            batch: The batch, or this process's share of it.
            losses: Loss of each of its rows, shape (rows,).
        """
        if self._shared is not None:
            batch = self._shared.whole
            losses = self._group.gather(losses if self._shared.weight else losses[:0])
        if self.source is not None and self.source.sets.learned is not None:
            self.source.sets.learned.tell(np.asarray(batch["episode"], np.int64), losses)

    @property
    def fields(self) -> Mapping[str, Field]:
        """The stored fields by name; those of the environments until something is stored."""
        if self._shared is not None:
            return self._shared.block.fields
        if self.online is not None and self.online.block.fields:
            return self.online.block.fields
        if self.source is not None and not self._stored.has_samples:
            return {field.name: field for field in self.source.fields}
        return self._stored.fields

    def normalization(self) -> dict[str, Normalization]:
        """Return the normalization of all rows up to those of the last batch, by field."""
        if self._shared is not None:
            return self._shared.block.normalization
        if self.online is not None and self.online.block.fields:
            return self.online.block.normalization
        return self._stored.normalization(recompute=False)

    def states(self, batches: int) -> tuple[Index | None, Array | None, bytes | None]:
        """Return the states of buffer, sampler and streams for a checkpoint; None: it has none.

        Args:
            batches: Number of batches already learned from: all, or all but the last one.
        """
        if self.online is None or self.source is None:
            return None, None, None
        learned = self.source.sets.learned
        sampler = None if learned is None else learned.state(batches)
        return self.online.state(batches), sampler, self.online.pasts(batches)

    def resume(self, found: checkpoint.Checkpoint, names: Sequence[str]) -> None:
        """Continue where a checkpoint was written, after at least one batch.

        Args:
            found: The checkpoint.
            names: Fields of the batches.

        Raises:
            CheckpointError: If its states do not match buffer and sampler.
        """
        if self.online is None or self.source is None:
            return
        batches, learned = found.progress.blocks, self.source.sets.learned
        state, stored = partial(checkpoint.read_buffer, found), self._stored
        try:
            if learned is not None:
                learned.restore(batches, checkpoint.read_sampler(found))
        except ValueError as error:
            raise CheckpointError(
                "The training cannot be resumed: the sampler state in its checkpoint does not "
                f"match, because {error}. Resume with the same sampler and sampler_kwargs."
            ) from error
        self.online.resume(batches, state, stored.dataset, stored.mode, self._drawn_fields(names))

    def finish(self) -> None:
        """End the last epoch: from now on the rows are read."""
        if self.online is not None:
            self.online.finish()
        if self._shared is not None:
            self._shared.finish(self._stored.dataset)
