"""EpisodeSource: the interface to what simulates the episodes of a campaign, and one in process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial

import numpy as np

from physx_core.dataset import EpisodeStatus
from physx_core.fields import Field
from physx_core.rows import concatenate
from physx_core.typing import Batch
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.episode_runner import EpisodeBlock, EpisodeRunner
from physx_core.workers.instance import Instance
from physx_core.workers.lease import Lease, most_numbers, say_without_states
from physx_core.workers.parameter_sets import ParameterSets


class EpisodeSource(ABC):
    """Simulates the numbers of a queue, in any order: what `Source.lease` returns.

    The rows of a number depend on the seed and the number alone.
    """

    def __init__(self, sets: ParameterSets, queue: EpisodeQueue) -> None:
        """Store what is simulated.

        Args:
            sets: Chooses the parameters of each number.
            queue: The numbers to simulate.
        """
        self._sets, self._queue = sets, queue

    @property
    @abstractmethod
    def fields(self) -> list[Field]:
        """Fields of the rows; shapes may be open before the first block."""

    @abstractmethod
    def take(self) -> EpisodeBlock:
        """Return the next rows, each checked, and the episodes that they belong to.

        It has no records if the queue is done. Records have the parameters of their episode.

        Raises:
            PhysxError: If an environment or client fails in a way that concerns all episodes.
        """

    def _settled(self, block: EpisodeBlock) -> EpisodeBlock:
        """Tell the queue which numbers a block ends."""
        for record in block.records:
            self._queue.note(record)
        return block

    def repeat(self, number: int, instance_id: int) -> Batch:
        """Simulate a number again once the queue is done, by another instance if there is one.

        Args:
            number: The number, which has finished.
            instance_id: The instance that has simulated it.

        Returns:
            Its rows, and each field that it has once with a first axis of length 1; of no fields
            if it fails now.

        Raises:
            PhysxError: See `take`.
        """
        self._queue.put_back(number)
        parts: list[Batch] = []
        while True:
            block = self._take_again(instance_id)
            begin = 0
            for record in block.records:
                end = begin + record.rows
                if record.episode == number:
                    part = {name: rows[begin:end].copy() for name, rows in block.rows.items()}
                    parts = [*parts, part] if record.part else [part]
                    if record.status is not EpisodeStatus.MORE:
                        own = {n: np.asarray(v)[None] for n, v in record.fields.items()}
                        return concatenate([part for part in parts if part]) | own
                begin = end

    @abstractmethod
    def _take_again(self, instance_id: int) -> EpisodeBlock:
        """Return what becomes of a number in the queue, given to another instance if possible."""


class LocalEpisodes(EpisodeSource):
    """Simulates the numbers one after another in this process, with one environment."""

    def __init__(
        self, instance: Instance, sets: ParameterSets, queue: EpisodeQueue, state_every: int
    ) -> None:
        """Prepare the simulation.

        Args:
            instance: Simulates the episodes; open.
            sets: Chooses the parameters of each number.
            queue: The numbers to simulate.
            state_every: Number of rows after which an episode gives a state; 0: never.
        """
        super().__init__(sets, queue)
        refuse = partial(say_without_states, instance.instance_id)
        self._runner = EpisodeRunner(instance, self._lease, refuse, state_every=state_every)
        self._leased = 0

    @property
    def fields(self) -> list[Field]:
        """Fields of the rows: see `EpisodeSource.fields`."""
        return self._runner.fields

    def take(self) -> EpisodeBlock:
        """Simulate the next episodes: see `EpisodeSource.take`."""
        return self._settled(self._take_again(0))

    def _take_again(self, instance_id: int) -> EpisodeBlock:
        block = self._runner.run()
        for record in block.records:
            self._queue.follow(record)
        return block

    def _lease(self) -> Lease | None:
        """Return the next numbers: at most twice as many as before, as sampling may be slow."""
        numbers = self._queue.take_range(min(1 + self._leased, most_numbers(self._sets.parameters)))
        self._leased += len(numbers)
        if not numbers:
            return None
        return Lease(numbers, self._sets.values_of(numbers), self._queue.begun(numbers[0]))
