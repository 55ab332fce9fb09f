"""DataGeneration: environments generate samples, and the dataset stores them."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import ClassVar

from physx_core.config import MODES, WRONG, DatasetConfig, EnvironmentConfig, at_least, options
from physx_core.dataset import Dataset, EpisodeStatus
from physx_core.errors import ConfigError, FailedEpisodesError, listed
from physx_core.pipelines.campaign import Campaign
from physx_core.pipelines.pipeline import NewSessionPipeline, choose_seed, derive_seed
from physx_core.pipelines.run_description import (
    describe_dataset,
    describe_environment_config,
    describe_failed_sets,
    describe_samples,
)
from physx_core.pipelines.services import RunServices
from physx_core.pipelines.storage import (
    check_client_writers,
    check_episodes,
    describe_environment,
    end_generation,
    open_own,
    record_beside_rows,
    store_sets,
)
from physx_core.session import Session
from physx_core.sources.episode_source import EpisodeSource, LocalEpisodes
from physx_core.sources.source import Source
from physx_core.typing import Batch
from physx_core.workers.episode_queue import EpisodeQueue


@options
@dataclass(eq=False)
class DataGeneration(NewSessionPipeline):
    """Generates samples and stores them in its session.

    These are ``batch_nb`` batches of ``batch_size`` samples of streams, or the samples of a
    number of independent ``episodes``. Each episode is stored when it ends, and what has been
    stored is never simulated again.

    Attributes:
        dataset: The session's dataset, open for writing.
        source: The environments.
        batch: The last batch; empty if the clients write their own rows.
        batch_id: Number of stored batches.
    """

    environment_config: EnvironmentConfig
    """The environment, and where its instances run."""
    dataset_config: DatasetConfig | None = None
    """How the samples are stored; None: `DatasetConfig()`."""
    _: KW_ONLY
    session_name: str = "data_generation"
    """Name of the new session."""
    batch_nb: int | None = at_least(1, None)
    """Number of batches to generate."""
    batch_size: int | None = at_least(1, None)
    """Number of samples in a batch."""
    episodes: int | None = at_least(1, None)
    """Number of independent episodes to simulate, instead of batches; those that fail count."""
    retries: int = at_least(0, 1)
    """Number of times that an episode is simulated again after its client was lost; then it has
    failed."""
    max_failed: int = at_least(0, 0)
    """Number of episodes that may fail before the run fails."""
    resume: bool = field(default=False, metadata={"recorded": False})
    """Go on with the episodes of an existing session: simulate those that it does not have."""
    mode: str | None = field(default=None, metadata={"choices": MODES})
    """Mode to store the samples in; None: `DatasetConfig.mode`."""

    kind: ClassVar[str] = "data_generation"
    dataset: Dataset = field(init=False, repr=False)
    source: Source = field(init=False, repr=False)
    batch: Batch = field(init=False, repr=False)
    batch_id: int = field(init=False, repr=False, default=0)
    _seed: int = field(init=False, repr=False, default=0)
    _mode: str = field(init=False, repr=False, default="")
    _campaign: Campaign = field(init=False, repr=False)
    _queue: EpisodeQueue = field(init=False, repr=False)
    _episodes: EpisodeSource = field(init=False, repr=False)
    _failed: int = field(init=False, repr=False, default=0)

    def __post_init__(self) -> None:
        """Check that the options ask for batches or for episodes.

        Raises:
            ConfigError: If they ask for both, or for neither.
        """
        batches = [self.batch_nb, self.batch_size]
        if (None in batches) if self.episodes is None else batches != [None, None]:
            raise ConfigError(
                "DataGeneration needs either batch_nb and batch_size, or episodes: the number of "
                "independent episodes."
            )
        if self.episodes is None and (self.resume or self.max_failed):
            option = "resume" if self.resume else "max_failed"
            raise ConfigError(f"DataGeneration.{option} is for episodes: give their number.")

    def execute(self) -> None:
        """Generate all batches, or simulate all episodes.

        Raises:
            PhysxError: If an environment fails or sets data that cannot be stored; committed
                samples are kept.
        """
        with self._running():
            self.observers.begin("generation", *self._amount())
            self.data_generation_begin()
            if self.episodes is None:
                self._generate_batches()
            else:
                while not self._queue.is_done:
                    self._store_episodes()
            self.data_generation_end()

    def _amount(self) -> tuple[int, str]:
        """Return how much there is to generate, and its unit."""
        if self.episodes is not None:
            return self.episodes - self._queue.finished, "episodes"
        return (self.batch_nb or 0) * (self.batch_size or 0), "samples"

    def _generate_batches(self) -> None:
        own = self._is_own(DataGeneration.batch_produce)
        while more := self.batch_condition():
            self.batch_begin()
            if own:
                self.batch_produce()
            else:
                self._check_batch_produce()
            self._count("batch_id", "batch_count")
            self.batch_end()
        self._check_condition(more, "batch_condition")

    def _store_episodes(self) -> None:
        """Store the episodes that end next; fail if too many of this run failed."""
        before, campaign = self._queue.finished, self._campaign.number
        rows, records = self._episodes.take()
        if self._mode not in self.dataset.modes:
            self.dataset.define_fields(self._mode, self._episodes.fields)
        records = [replace(record, campaign=campaign) for record in records]
        self.dataset.append_episodes(self._mode, rows, records, checked=True)
        self.observers.advance(self._queue.finished - before)
        failed = [record for record in records if record.status is EpisodeStatus.FAILED]
        self._failed += len(failed)
        if failed and self._failed > self.max_failed:
            raise FailedEpisodesError(self._failed, failed[-1].episode, failed[-1].reason)

    def data_generation_begin(self) -> None:
        """Called before the first batch."""

    def batch_condition(self) -> bool:
        """Return whether there are batches left to generate."""
        return self.batch_nb is not None and self.batch_id < self.batch_nb

    def batch_begin(self) -> None:
        """Called before each batch."""

    def batch_produce(self) -> None:
        """Generate a batch and store it; the samples are committed when this returns.

        With ``record_wrong_samples``, the samples that `check_sample` rejected are stored too, in
        the mode "wrong".
        """
        source, dataset, mode = self.source, self.dataset, self._mode
        with record_beside_rows(source, dataset, mode):
            self.batch = source.batch(self.batch_size or 0)
            if not source.is_plain:
                store_sets(source, dataset, mode)
            if self.batch_id == 0:
                dataset.define_fields(mode, source.fields)
                self._describe()
            if self.batch:
                dataset.append(mode, self.batch, checked=True)

    def _check_batch_produce(self) -> None:
        """Call a replacement of `batch_produce`, which must store samples."""
        before = self.dataset.num_samples(self._mode)
        self.batch_produce()
        if self.dataset.num_samples(self._mode) == before:
            store = f"store them with self.dataset.append({self._mode!r}, ...)"
            raise self._lacks("batch_produce", "stored no samples", store)
        if self.batch_id == 0:
            self._describe()

    def _describe(self) -> None:
        """Store with the samples which environment generated them."""
        described = describe_environment(self.environment_config, self._seed)
        self.dataset.update_info(**described)

    def batch_count(self) -> None:
        """Count the batch."""
        self.batch_id += 1
        self.observers.advance(self.batch_size or 0)

    def batch_end(self) -> None:
        """Called after each batch."""

    def data_generation_end(self) -> None:
        """Called after the last batch."""

    def _begin(self) -> None:
        self.batch_id = self._failed = 0
        end_generation(self.dataset)

    def _open(self, resources: contextlib.ExitStack) -> None:
        dataset_config = self.dataset_config or DatasetConfig()
        self._mode = self.mode or dataset_config.mode
        if dataset_config.existing_dir is not None:
            raise ConfigError(
                "DataGeneration writes to its own session's dataset, so existing_dir cannot be "
                "set. To add to a session, give its name and new_session=False."
            )
        config = self.environment_config
        if config.load_samples:
            raise ConfigError(
                "DataGeneration generates new samples, so load_samples cannot be set: it works in "
                "Training, Prediction and Replay."
            )
        if self.episodes is not None:
            check_episodes(config, dataset_config)
        if dataset_config.writers == "clients":
            check_client_writers(config)
        if self._mode == WRONG:
            raise ConfigError(
                'The mode "wrong" is for samples that check_sample rejects. Generate samples for '
                f"{listed(MODES)}, with record_wrong_samples=True to keep the rejected ones."
            )
        if self.resume:
            self.session = Session.existing(self.session_dir, self.session_name)
        else:
            self.session = self._create_session()
        self.dataset = resources.enter_context(open_own(self.session, dataset_config))
        if self.episodes is None:
            self._open_batches(resources, config, dataset_config)
        else:
            self._open_episodes(resources, config, self.episodes)

    def _open_batches(
        self,
        resources: contextlib.ExitStack,
        config: EnvironmentConfig,
        dataset_config: DatasetConfig,
    ) -> None:
        offset = self.dataset.num_samples(self._mode)
        self._seed = seed = choose_seed(config.seed)
        self._record_config(seed)
        self._observe(resources, config)
        stripes = None
        if dataset_config.writers == "clients":
            stripes = self.dataset.stripes(self._mode, config.num_clients)
        self.source = self._open_source(
            resources,
            config,
            derive_seed(seed, self._mode, offset),
            total=self._amount()[0],
            stripes=stripes,
        )

    def _open_episodes(
        self, resources: contextlib.ExitStack, config: EnvironmentConfig, episodes: int
    ) -> None:
        """Open the environments, unless there is nothing left to simulate."""
        make = Campaign.last if self.resume else Campaign.begin
        self._campaign = campaign = make(self.dataset, self._mode, config)
        self._seed = campaign.environment["seed"]
        self._record_config(self._seed)
        self._observe(resources, config)
        self._describe()
        known = campaign.simulated(self.dataset)
        self._queue = EpisodeQueue(episodes, known, self.retries)
        if not self._queue.is_done:
            self._episodes = resources.enter_context(self._make_episodes(config, campaign.seed))

    def _make_episodes(self, config: EnvironmentConfig, seed: Sequence[int]) -> EpisodeSource:
        """Return what simulates the numbers of the queue, in this process or in clients."""
        services = RunServices(self.session.dataset_dir, self.observers.events, None)
        if not config.as_tcp_ip_client:
            return LocalEpisodes(config, services, seed, self._queue)
        from physx_core.sources.client_episodes import ClientEpisodes

        return ClientEpisodes(config, services, seed, self._queue)

    def _results(self, error: BaseException | None) -> Iterable[str]:
        duration = self._duration
        if self.episodes is not None:
            failed = f", of which {self._failed} failed" if self._failed else ""
            yield f"{self._queue.finished} of {self.episodes} episodes{failed} in {duration:.2f} s"
            yield describe_samples(self.dataset.directory)
            return
        count = self.batch_id
        rate = count * (self.batch_size or 0) / duration
        yield f"{count} of {self.batch_nb} batches in {duration:.2f} s, {rate:.0f} samples/s"
        yield describe_samples(self.dataset.directory)
        yield from describe_failed_sets(self.source)

    def _next(self, error: BaseException | None) -> Iterable[str]:
        path = shlex.quote(str(self.session.path))
        if error is not None and self.episodes is not None:
            yield f"physx generate {path} --resume"
        yield f"physx info {path}"
        if error is None and self._mode == "training":
            options = "--network.network NETWORK --epoch-nb N --batch-size N"
            yield f"physx train {path} {options}"

    def _components(self) -> Mapping[str, str]:
        return {
            "environment": describe_environment_config(self.environment_config),
            "dataset": describe_dataset(self.dataset),
        }
