"""EpisodeSource: the interface to what simulates the episodes of a campaign, and one in process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any

from physx_core.dataset import EpisodeStatus
from physx_core.fields import Field
from physx_core.rows import concatenate
from physx_core.typing import Batch
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.episode_runner import EpisodeBlock, EpisodeRunner
from physx_core.workers.instance import Instance
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
        self._values: dict[int, dict[str, Any]] = {}  # of the numbers that are being simulated

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

    def _choose(self, number: int) -> dict[str, Any]:
        """Return the parameters of a number; empty if there are none."""
        if not self._sets.parameters:
            return {}
        if number not in self._values:
            self._values[number] = self._sets.values_of(number)
        return dict(self._values[number])

    def _settled(self, block: EpisodeBlock) -> EpisodeBlock:
        """Add the parameters to a block's records, and tell the queue which numbers it ends."""
        records = block.records
        if self._sets.parameters:
            records = [replace(each, parameters=self._choose(each.episode)) for each in records]
        for record in records:
            self._queue.note(record)
            if record.status is not EpisodeStatus.MORE:
                self._values.pop(record.episode, None)
        return block._replace(records=records)

    def repeat(self, number: int, instance_id: int) -> Batch:
        """Simulate a number again once the queue is done, by another instance if there is one.

        Args:
            number: The number, which has finished.
            instance_id: The instance that has simulated it.

        Returns:
            Its rows; of no fields if it fails now.

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
                        return concatenate([part for part in parts if part])
                begin = end

    @abstractmethod
    def _take_again(self, instance_id: int) -> EpisodeBlock:
        """Return what becomes of a number in the queue, given to another instance if possible."""


class LocalEpisodes(EpisodeSource):
    """Simulates the numbers one after another in this process, with one environment."""

    def __init__(self, instance: Instance, sets: ParameterSets, queue: EpisodeQueue) -> None:
        """Prepare the simulation.

        Args:
            instance: Simulates the episodes; open.
            sets: Chooses the parameters of each number.
            queue: The numbers to simulate.
        """
        super().__init__(sets, queue)
        instance.choose_by(self._choose)
        self._runner = EpisodeRunner(instance, queue.take)

    @property
    def fields(self) -> list[Field]:
        """Fields of the rows: see `EpisodeSource.fields`."""
        return self._runner.fields

    def take(self) -> EpisodeBlock:
        """Simulate the next episodes: see `EpisodeSource.take`."""
        return self._settled(self._runner.run())

    def _take_again(self, instance_id: int) -> EpisodeBlock:
        return self._runner.run()
