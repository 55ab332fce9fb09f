"""EpisodeSource: the interface to what simulates the episodes of a campaign, and one in process."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

from physx_core.components.environment import Services
from physx_core.components.parameter import Parameter
from physx_core.config import EnvironmentConfig
from physx_core.dataset import EpisodeStatus
from physx_core.fields import Field
from physx_core.sources.source import Opened
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.episode_runner import EpisodeBlock, EpisodeRunner
from physx_core.workers.instance import Instance, instance_arguments
from physx_core.workers.lease import Lease, most_numbers
from physx_core.workers.parameter_sets import ParameterSets


class EpisodeSource(Opened):
    """Simulates the numbers of a queue, in any order; a context manager.

    The rows of a number depend on the seed and the number alone.
    """

    def __init__(self, config: EnvironmentConfig, seed: Sequence[int], queue: EpisodeQueue) -> None:
        """Store what is simulated.

        Args:
            config: The environment, and its sampler.
            seed: Seed of the campaign.
            queue: The numbers to simulate.
        """
        self._config, self._seed, self._queue = config, list(seed), queue
        self._sets = ParameterSets(config, seed)

    @property
    @abstractmethod
    def fields(self) -> list[Field]:
        """Fields of the rows; shapes may be open before the first block."""

    @property
    def parameters(self) -> list[Parameter]:
        """The parameters of the environment."""
        return self._sets.parameters

    @abstractmethod
    def open(self) -> None:
        """Create the environments.

        Raises:
            PhysxError: If an environment or client fails, or its episodes are not independent.
        """

    @abstractmethod
    def take(self) -> EpisodeBlock:
        """Return the next rows, each checked, and the episodes that they belong to.

        It has no records if the queue is done. Records have the parameters of their episode.

        Raises:
            PhysxError: If an environment or client fails in a way that concerns all episodes.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the environments, and end their clients. Calling it again does nothing."""

    def _settled(self, block: EpisodeBlock) -> EpisodeBlock:
        """Tell the queue which numbers a block ends."""
        for record in block.records:
            if record.status is not EpisodeStatus.MORE:
                self._queue.finish(record.count)
        return block


class LocalEpisodes(EpisodeSource):
    """Simulates the numbers one after another in this process, with one environment."""

    def __init__(
        self,
        config: EnvironmentConfig,
        services: Services,
        seed: Sequence[int],
        queue: EpisodeQueue,
    ) -> None:
        """Prepare the environment; see `EpisodeSource` for the arguments.

        Args:
            config: The environment, and its sampler.
            services: Serves the environment's requests.
            seed: Seed of the campaign.
            queue: The numbers to simulate.
        """
        super().__init__(config, seed, queue)
        self._services = services
        self._instance = Instance(**instance_arguments(config, 1, seed, accept_all=False))
        self._runner: EpisodeRunner | None = None
        self._leased = 0

    @property
    def fields(self) -> list[Field]:
        """Fields of the rows: see `EpisodeSource.fields`."""
        return [] if self._runner is None else self._runner.fields

    def open(self) -> None:
        """Create the environment: see `EpisodeSource.open`."""
        draw = self._config.visualizer is not None
        self._instance.open(self._services, draw)
        self._sets.begin([self._instance.parameters])
        self._runner = EpisodeRunner(self._instance, self._lease)

    def take(self) -> EpisodeBlock:
        """Simulate the next episodes: see `EpisodeSource.take`."""
        assert self._runner is not None
        return self._settled(self._runner.run())

    def _lease(self) -> Lease | None:
        """Return the next numbers: at most twice as many as before, as sampling may be slow."""
        numbers = self._queue.take_range(min(1 + self._leased, most_numbers(self.parameters)))
        self._leased += len(numbers)
        return Lease(numbers, self._sets.values_of(numbers)) if numbers else None

    def close(self) -> None:
        """Close the environment: see `EpisodeSource.close`."""
        self._instance.close()
