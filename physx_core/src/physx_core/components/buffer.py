"""Buffer: decides which rows each training batch holds while environments generate them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from physx_core.errors import UsageError
from physx_core.typing import Index

_STREAM = 2


class BatchSelection(NamedTuple):
    """What a buffer decided for one batch.

    Attributes:
        placed: Slot of each row that arrived for the batch; a later row replaces an earlier one.
        drawn: Slot of each of the batch's rows, once the arrived rows are placed.
        rows: Number of each of the batch's rows.
    """

    placed: Index
    drawn: Index
    rows: Index


class Buffer(ABC):
    """Base of all buffers; plugins offer their own with the hook ``physx_buffers``.

    While environments generate, rows arrive in an order determined by the seed and the number of
    instances, and are numbered from 0. A buffer keeps some of them in *slots*, from which batches
    are drawn. It handles row numbers only: the training run keeps the values. All its decisions
    depend on the seed and on counts, never on time, so runs can be repeated and resumed.

    The constructor takes the entries of `Training.online_kwargs`.

    Attributes:
        capacity: Number of slots. 0: nothing is kept, and each batch consists of the rows that
            arrive for it; then only `needed` has to be implemented.
        batch_size: Number of rows in a batch.
        batch_nb: Number of batches in the run.
        arrived: Number of rows that have arrived.
        rows: Number of the row in each slot, shape (capacity,), int64; -1: none.
        uses: How many times the row in each slot was drawn, shape (capacity,), int64.
    """

    capacity: int = 0
    batch_size: int = 1
    batch_nb: int = 0
    arrived: int = 0
    rows: Index
    uses: Index
    _seed: int = 0
    _taken: int = 0
    _before: tuple[int, Index, Index, Index, Index]

    def begin(self, batch_size: int, batch_nb: int, seed: int) -> None:
        """Start empty; called once before everything else.

        Args:
            batch_size: Number of rows in a batch.
            batch_nb: Number of batches in the run.
            seed: Seed of the training.

        Raises:
            ConfigError: If the buffer's options do not fit these numbers.
        """
        self.batch_size, self.batch_nb, self._seed = batch_size, batch_nb, seed
        self.arrived = self._taken = 0
        self.rows = np.full(self.capacity, -1, np.int64)
        self.uses = np.zeros(self.capacity, np.int64)

    @abstractmethod
    def needed(self, batch: int) -> int:
        """Return how many rows must have arrived before a batch is drawn.

        It depends only on the options and the arguments of `begin`, and never decreases.

        Args:
            batch: Number of the batch, from 0 over the whole run.
        """

    @property
    def total(self) -> int:
        """Number of rows that the whole run needs."""
        return self.needed(self.batch_nb - 1) if self.batch_nb else 0

    def place(self, count: int, random: np.random.Generator) -> Index:
        """Return the slots for the next rows; the rows previously in them are dropped.

        Args:
            count: Number of rows that have just arrived.
            random: The only source of random numbers.
        """
        raise NotImplementedError(f"{type(self).__name__} does not implement place().")

    def draw(self, random: np.random.Generator) -> Index:
        """Return the slots of a batch's rows, `batch_size` of them.

        Args:
            random: The only source of random numbers.
        """
        raise NotImplementedError(f"{type(self).__name__} does not implement draw().")

    def take(self, batch: int, count: int) -> BatchSelection:
        """Place the rows that have arrived for a batch, then draw the batch.

        Args:
            batch: Number of the batch.
            count: Number of rows that have arrived since the last one.

        Raises:
            UsageError: If `place` or `draw` returns invalid slots.
        """
        random = np.random.default_rng([self._seed, _STREAM, batch])
        arrived, placed = self.arrived, np.zeros(0, np.intp)
        if count:
            placed = self._slots("place", self.place(count, random), count)
        before = self.rows[placed], self.uses[placed]
        self.rows[placed] = np.arange(arrived, arrived + count)
        self.uses[placed] = 0
        self.arrived += count
        drawn = self._slots("draw", self.draw(random), self.batch_size)
        rows = self.rows[drawn]
        if rows.min() < 0:
            raise UsageError(f"{type(self).__name__}.draw() returned a slot without a row.")
        np.add.at(self.uses, drawn, 1)
        self._taken, self._before = batch + 1, (arrived, placed, *before, drawn)
        return BatchSelection(placed, drawn, rows)

    @property
    def kept(self) -> Index:
        """Numbers of the rows from which batches are drawn."""
        return self.rows[self.rows >= 0]

    def state(self, batches: int) -> Index:
        """Return what `restore` needs to continue after some batches, as integers.

        Args:
            batches: Number of batches: all that were taken since the run began, or all but the
                last one.
        """
        arrived, rows, uses = self.arrived, self.rows.copy(), self.uses.copy()
        if batches < self._taken:
            arrived, placed, rows_before, uses_before, drawn = self._before
            np.subtract.at(uses, drawn, 1)
            rows[placed], uses[placed] = rows_before, uses_before
        return np.concatenate([[arrived], rows, uses])

    def restore(self, batches: int, state: Index) -> None:
        """Continue from a `state` of a buffer with the same options; called after `begin`.

        Args:
            batches: Number of batches after which the state was taken.
            state: The state.

        Raises:
            ValueError: If `state` is not the state of such a buffer.
        """
        if state.shape != (1 + 2 * self.capacity,):
            raise ValueError("it is the state of a buffer with other options")
        rows, uses = state[1 : self.capacity + 1], state[self.capacity + 1 :]
        if not (np.all(rows < state[0]) and np.all(rows >= -1) and np.all(uses >= 0)):
            raise ValueError("it contains rows that have not arrived")
        self.arrived, self.rows, self.uses = int(state[0]), rows.copy(), uses.copy()
        self._taken = batches

    def _slots(self, method: str, slots: Index, count: int) -> Index:
        slots = np.asarray(slots)
        if slots.shape != (count,) or slots.min() < 0 or slots.max() >= self.capacity:
            raise UsageError(
                f"{type(self).__name__}.{method}() must return {count} slots from 0 to "
                f"{self.capacity - 1}."
            )
        return slots
