"""Opens the parts of a training before its first batch."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

from physx_core import checkpoint
from physx_core.checkpoint import Progress
from physx_core.components.buffer import Buffer
from physx_core.components.group import Group
from physx_core.components.network import Network
from physx_core.config import EnvironmentConfig, NetworkConfig
from physx_core.dataset import Dataset
from physx_core.errors import CheckpointError, ConfigError, UsageError
from physx_core.pipelines.campaign import Campaign
from physx_core.pipelines.campaign_writer import CampaignWriter
from physx_core.pipelines.generation import Generation
from physx_core.pipelines.learning.batches.blocks import Block, Blocks
from physx_core.pipelines.learning.batches.drawn_rows import DrawnRows
from physx_core.pipelines.learning.batches.feeder import Feeder
from physx_core.pipelines.learning.batches.generated import GeneratedBatches
from physx_core.pipelines.learning.batches.online import OnlineBatches
from physx_core.pipelines.learning.batches.replayed import ReplayedBatches
from physx_core.pipelines.learning.batches.row_statistics import RowStatistics
from physx_core.pipelines.learning.batches.stored import StoredBatches
from physx_core.pipelines.learning.resuming import Start, advise
from physx_core.pipelines.learning.training_data import TrainingData
from physx_core.pipelines.pipeline import derive_seed
from physx_core.pipelines.services import Predict, Show
from physx_core.pipelines.storage import (
    GENERATION,
    copy_existing,
    describe_environment,
    open_existing,
    open_own,
    reject_episode_fields,
)
from physx_core.pipelines.stored_episodes import find_begun
from physx_core.plugins.networks import resolve_network
from physx_core.session import Session
from physx_core.sources.source import Source
from physx_core.typing import Batch
from physx_core.workers.pasts import NOTHING, Skip, unpack
from physx_core.workers.row_queue import RowQueue


def join_group(config: NetworkConfig) -> tuple[Group, Any]:
    """Join the group of processes in which the network's library trains.

    Returns:
        The group, and the class whose `Network.set_seed` seeds the library.
    """
    component: Any = Network
    if config.network is not None:  # else the learner reports it
        made, _ = resolve_network(config.network, config.network_kwargs)
        if hasattr(made, "join_group"):  # else a function that returns a network
            component = made
    return component.join_group(config.device), component


def open_dataset(session: Session, start: Start, group: Group) -> Dataset:
    """Open the dataset; if rows are added, only the leading process opens it for writing."""
    config = start.config
    if start.environment is None:
        return open_existing(session, config)
    if group.is_main:
        dataset = open_own(session, config)
        copy_existing(dataset, config)
    group.broadcast(None)
    return dataset if group.is_main else open_existing(session, config)


@dataclass(eq=False)
class DataOpening:
    """Opens a training's data, and the environments that generate them.

    Attributes:
        start: Where the training starts.
        session: Its session.
        group: The processes that train together; only the leading one has environments.
        buffer: Decides what batches contain while environments generate; already started.
        progress: Progress when the training last ended.
        batch_nb: Batches in an epoch; None: one pass over the stored samples.
        validation_batch_size: Samples in each process's share of a validation batch; None: as many
            as in a training batch.
        batch_fields: Names of the fields of a batch.
        data_type: Floating-point type of batches that are read.
        ahead: Whether all batches of an epoch will be taken, and so may be generated ahead.
        open_source: Opens environments: `Pipeline._open_source` without its first argument.
        predict: The network's prediction for a batch; called in the training's thread.
        show: Receives drawing events; called in the training's thread.
        run_ahead, max_failed: See `Training`.
    """

    start: Start
    session: Session
    group: Group
    buffer: Buffer
    progress: Progress
    _: KW_ONLY
    batch_nb: int | None
    validation_batch_size: int | None
    batch_fields: Sequence[str]
    data_type: str
    ahead: bool
    open_source: Callable[..., Source]
    predict: Predict
    show: Show
    run_ahead: int
    max_failed: int
    _generation: Generation | None = field(init=False, default=None)

    def open(self, resources: contextlib.ExitStack, dataset: Dataset) -> TrainingData:
        """Open the data.

        Args:
            resources: Closes everything that is opened here.
            dataset: The open dataset; writable in the leading process if environments generate
                samples.

        Raises:
            PhysxError: If there are no samples, or environments fail.
        """
        environment, size = self.start.environment, self.buffer.batch_size
        stored = StoredBatches(
            dataset,
            self.start.config,
            environment,
            batch_size=size,
            validation_batch_size=(self.validation_batch_size or 0) * self.group.size or size,
            seed=self.progress.seed,
            batch_fields=self.batch_fields,
            data_type=self.data_type,
            first=self.progress.batches_read,
            snapshots=self.progress.snapshots,
        )
        made: GeneratedBatches | ReplayedBatches | None = None
        always = False
        if environment is not None and environment.load_samples:
            made = self._open_replay(environment, stored)
            always = not environment.only_first_epoch
        elif environment is not None:
            made = self._open_generation(resources, environment, stored)
            always = environment.always_produce
        return TrainingData(stored, made, batch_nb=self.batch_nb, always=always)

    def _open_replay(
        self, environment: EnvironmentConfig, stored: StoredBatches
    ) -> ReplayedBatches:
        """Have environments replay the stored samples."""
        offset = stored.dataset.num_samples("training")
        source = self._open_environments(environment, stored.dataset, offset, run_ahead=0)
        seed = self.progress.seed if self.start.config.shuffle else None
        return ReplayedBatches(source, stored, batch_size=self.buffer.batch_size, seed=seed)

    def _open_generation(
        self,
        resources: contextlib.ExitStack,
        environment: EnvironmentConfig,
        stored: StoredBatches,
    ) -> GeneratedBatches:
        """Have environments generate samples, in the leading process."""
        if self.batch_nb is None:
            raise ConfigError(
                "Training.batch_nb is missing: it is the number of batches to generate in an epoch."
            )
        source = online = None
        if self.group.is_main:
            source, online = self._open_online(resources, environment, stored)
        made = GeneratedBatches(
            stored, source, online, self.group, ahead=self.ahead, repeats=self._repeats
        )
        if self.start.checkpoint is not None and self.progress.blocks:
            made.resume(self.start.checkpoint, self.batch_fields)
        return made

    def _open_online(
        self,
        resources: contextlib.ExitStack,
        environment: EnvironmentConfig,
        stored: StoredBatches,
    ) -> tuple[Source, OnlineBatches]:
        dataset, buffer = stored.dataset, self.buffer
        feeder = Feeder[Block]() if environment.as_tcp_ip_client else None
        generation, skip = self._begin_generation(dataset, environment)
        source = self._open_environments(
            environment,
            dataset,
            generation.offset,
            feeder,
            total=buffer.total,
            skip=skip,
            keeps_pasts=True,
        )
        drawn = None
        if buffer.capacity:
            drawn = DrawnRows(self.session, buffer.batch_size, self.progress.blocks)
            resources.callback(drawn.close)
        writer = self._open_campaign(resources, dataset, environment, source, generation)
        blocks = Blocks(
            source,
            dataset,
            stored.mode,
            normalize=self.start.config.normalize,
            first=generation.first,
            known=skip,
            statistics=RowStatistics(self.progress.seed, buffer.total),
            writer=writer,
            feeder=feeder,
        )
        resources.push(lambda kind, *_: blocks.finish() if kind is None else None)
        resources.callback(blocks.close)
        return source, OnlineBatches(blocks, buffer, self.data_type, drawn, generation.first)

    def _open_campaign(
        self,
        resources: contextlib.ExitStack,
        dataset: Dataset,
        environment: EnvironmentConfig,
        source: Source,
        generation: Generation,
    ) -> CampaignWriter | None:
        """Open what simulates and stores independent episodes; None: the rows are of streams."""
        mode, number = self.start.config.mode, generation.campaign
        if number is not None:
            campaign = Campaign.last(dataset, mode, environment, number)
        elif source.is_independent:
            seed = self._seed_of(environment)
            seeds, parameters = derive_seed(seed, "training", generation.offset), source.sets
            campaign = Campaign.begin(
                dataset, mode, environment, seed, seeds, parameters.parameters
            )
            self._generation = dataclasses.replace(generation, campaign=campaign.number)
            self._generation.store(dataset)
        else:
            reject_episode_fields(source)
            return None
        states, begun = find_begun(self.session, dataset, campaign, environment)
        if states is not None:
            resources.callback(states.close)
        queue = RowQueue(self.buffer.total, campaign.ended(dataset), environment.retries, begun)
        writer = CampaignWriter(
            dataset,
            campaign,
            queue,
            self.max_failed,
            keeps_rejected=environment.record_wrong_samples,
            states=states,
        )
        source.sets.follow(queue, self.buffer.needed, self.buffer.batch_nb, self.run_ahead)
        writer.open(source)
        return writer

    def _open_environments(
        self,
        environment: EnvironmentConfig,
        dataset: Dataset,
        offset: int,
        feeder: Feeder[Block] | None = None,
        **options: Any,
    ) -> Source:
        """Open environments.

        Args:
            environment: The environment.
            dataset: Dataset in which the samples' origin is recorded.
            offset: Number of samples that existed before.
            feeder: Takes their samples in its thread; None: the training's thread does.
            options: Further arguments of `open_source`.
        """
        seed = self._seed_of(environment)
        dataset.update_info(**describe_environment(environment, seed))

        def predict(batch: Batch) -> Batch:
            if self._generation is not None and self._generation.campaign is not None:
                raise UsageError(
                    "An independent episode depends on nothing but its number, so it cannot ask "
                    "the network that learns from it: set "
                    "EnvironmentConfig.independent_episodes=False to generate streams."
                )
            self._note_dependence(dataset)
            return self.predict(batch)

        return self.open_source(
            environment,
            derive_seed(seed, "training", offset),
            predict=predict if feeder is None else feeder.calling(predict),
            show=None if feeder is None else feeder.telling(self.show),
            **options,
        )

    def _begin_generation(
        self, dataset: Dataset, environment: EnvironmentConfig
    ) -> tuple[Generation, Skip]:
        """Record what the environments' rows depend on; return the rows that an earlier run had."""
        described = describe_environment(environment, self._seed_of(environment))
        now = Generation.begin(
            GENERATION,
            dataset,
            self.start.config.mode,
            self.progress.seed,
            described,
            self.buffer.batch_size,
            self.batch_nb,
        )
        former = self.start.generation
        self._generation = former or now
        if former is None:
            now.keep_parameters(dataset)
            now.start(dataset)
            return now, NOTHING
        advice = advise(self.session.path)
        skip = former.resume(dataset, environment, now, self.buffer.total, advice)
        former.restore_parameters(dataset)
        return former, self._find_place(former, skip, environment.num_clients)

    def _find_place(self, former: Generation, skip: Skip, count: int) -> Skip:
        """Return what streams do not have to return: all that is stored, or what is before states.

        Args:
            former: Describes them.
            skip: What is stored.
            count: How many they are.
        """
        found = self.start.checkpoint
        if found is None or not checkpoint.has_streams(found):  # they repeat all rows
            return skip._replace(rows=0) if former.depends else skip
        try:
            rows, pasts = unpack(checkpoint.read_streams(found))
        except ValueError as error:
            raise CheckpointError(
                f"The states of environments in {found.path} cannot be used: {error}. Use another "
                "checkpoint."
            ) from error
        if rows > skip.rows or not all(skip.covers(n, past, count) for n, past in pasts.items()):
            raise CheckpointError(
                f"The states of environments in {found.path} are after rows that did not reach the "
                "disk. Rename or remove its folder to resume from the checkpoint before it."
            )
        return skip._replace(rows=rows, pasts=pasts)

    def _seed_of(self, environment: EnvironmentConfig) -> int:
        return self.progress.seed if environment.seed is None else environment.seed

    def _note_dependence(self, dataset: Dataset) -> None:
        """Record in the dataset that the environments' rows depend on the learning network."""
        if self._generation is not None and not self._generation.depends:
            self._generation = dataclasses.replace(self._generation, depends=True)
            self._generation.store(dataset)

    def _repeats(self) -> bool:
        """Return whether environments would generate the same samples again."""
        environment, generation = self.start.environment, self._generation
        has_states = environment is not None and environment.state_every > 0
        return generation is not None and (has_states or not generation.depends)
