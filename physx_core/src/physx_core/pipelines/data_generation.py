"""DataGeneration: environments generate samples, and the dataset stores them."""

from __future__ import annotations

import contextlib
import math
import shlex
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from physx_core.config import MODES, WRONG, EnvironmentConfig, at_least, options, read_toml
from physx_core.dataset import Dataset
from physx_core.errors import ConfigError, listed
from physx_core.pipelines.campaign import Campaign
from physx_core.pipelines.campaign_writer import CampaignWriter
from physx_core.pipelines.generation import Generation
from physx_core.pipelines.pipeline import NewSessionPipeline, choose_seed, derive_seed
from physx_core.pipelines.run_description import (
    describe_dataset,
    describe_environment_config,
    describe_samples,
)
from physx_core.pipelines.saved_parameters import forget_parameters, remove_unused_parameters
from physx_core.pipelines.storage import (
    GENERATION,
    STREAMS,
    check_client_writers,
    describe_environment,
    end_generation,
    open_own,
    record_beside_rows,
    reject_episode_fields,
    reject_streams_of_writers,
    store_sets,
)
from physx_core.pipelines.stored_episodes import find_begun
from physx_core.pipelines.stored_streams import StoredStreams
from physx_core.results import Result
from physx_core.session import Session
from physx_core.sources.source import Source
from physx_core.typing import Batch
from physx_core.views.dataset_config import DatasetConfig
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.pasts import NOTHING, PastFiles
from physx_core.workers.row_queue import RowQueue


@options
@dataclass(eq=False)
class DataGeneration(NewSessionPipeline):
    """Generates samples and stores them in its session.

    These are ``batch_nb`` batches of ``batch_size`` samples, or the samples of a number of
    independent ``episodes``. If the environment's episodes are independent, each is stored when it
    ends, and what has been stored is never simulated again. The samples of batches are then those
    of as many episodes as they need, of which the last one may be cut.

    Attributes:
        dataset: The session's dataset, open for writing.
        source: The environments.
        batch: The last batch of a stream; empty if episodes are stored as they end.
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
    max_failed: int = at_least(0, 0)
    """Number of episodes that may fail before the run fails."""
    prove_independence: bool = True
    """Simulate one of the independent episodes again at the end, if that costs less than 1 % of the
    run, and fail if its samples differ in any bit."""
    resume: bool = field(default=False, metadata={"recorded": False})
    """Go on with the samples of an existing session: simulate the independent episodes that it does
    not have; or let streams go on from their last states (`EnvironmentConfig.state_every`), else
    from their beginning, and store what is missing."""
    retry_failed: bool = field(default=False, metadata={"recorded": False})
    """With `resume`: also simulate the episodes again that failed, for example because of a mistake
    that has been mended."""
    mode: str | None = field(default=None, metadata={"choices": MODES})
    """Mode to store the samples in; None: `DatasetConfig.mode`."""

    kind: ClassVar[str] = "data_generation"
    dataset: Dataset = field(init=False, repr=False)
    source: Source = field(init=False, repr=False)
    batch: Batch = field(init=False, repr=False)
    batch_id: int = field(init=False, repr=False, default=0)
    _seed: int = field(init=False, repr=False, default=0)
    _mode: str = field(init=False, repr=False, default="")
    _writer: CampaignWriter | None = field(init=False, repr=False, default=None)
    _first_row: int = field(init=False, repr=False, default=0)
    _former_rows: int = field(init=False, repr=False, default=0)
    _rows: int = field(init=False, repr=False, default=0)
    _streams: StoredStreams | None = field(init=False, repr=False, default=None)
    _states: PastFiles | None = field(init=False, repr=False, default=None)
    _is_described: bool = field(init=False, repr=False, default=False)

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

    def execute(self) -> Result:
        """Generate all batches, or simulate all episodes.

        Raises:
            PhysxError: If an environment fails or sets data that cannot be stored; committed
                samples are kept.
        """
        with self._running():
            before = self.dataset.num_samples(self._mode)
            self.observers.begin("generation", *self._amount())
            self.data_generation_begin()
            try:
                if self.episodes is None:
                    self._generate_batches()
                else:
                    self._simulate_episodes()
                if self._writer is not None and self.prove_independence:
                    self._writer.prove_independence()
                self.data_generation_end()
            finally:
                self._rows = self.dataset.num_samples(self._mode) - before
        return self.result

    def _amount(self) -> tuple[int, str]:
        """Return how much there is to generate, and its unit."""
        if self.episodes is not None:
            known = 0 if self._writer is None else self._writer.queue.finished
            return self.episodes - known, "episodes"
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

    def _simulate_episodes(self) -> None:
        writer = self._writer
        while writer is not None and not writer.queue.is_done:
            self.observers.advance(writer.store())
        if writer is not None and writer.queue.finished > writer.failed and not writer.rows:
            warnings.warn(
                "All episodes that have finished ended without a row: call set_training_data() in "
                "each step, also in that which calls end_episode().",
                stacklevel=2,
            )

    def _cut(self, kind: type[BaseException] | None, *_: object) -> None:
        """Leave out what the last episodes have more than the batches, when the run is closed."""
        if kind is None and self._writer is not None and self.episodes is None:
            rows = self._first_row + self.batch_id * (self.batch_size or 0)
            self._writer.cut(max(rows, self._former_rows))

    def data_generation_begin(self) -> None:
        """Called before the first batch."""

    def batch_condition(self) -> bool:
        """Return whether there are batches left to generate."""
        return self.batch_nb is not None and self.batch_id < self.batch_nb

    def batch_begin(self) -> None:
        """Called before each batch."""

    def batch_produce(self) -> None:
        """Generate a batch and store it; the samples are committed when this returns.

        Of independent episodes there may be more samples until the pipeline is closed.

        With ``record_wrong_samples``, the samples that `check_sample` rejected are stored too, in
        the mode "wrong".
        """
        wanted = self._first_row + (self.batch_id + 1) * (self.batch_size or 0)
        if self._writer is not None:
            self.batch = {}
            self._writer.store_rows(wanted)
            return
        streams, missing = self._streams, self.batch_size or 0
        earlier: dict[int, int] = {}
        if streams is not None:
            missing = streams.missing(wanted, missing)
        if not missing:  # an earlier run has stored it
            self.batch = {}
            return
        if streams is not None:
            earlier, streams.earlier = streams.earlier, earlier
        source, dataset, mode = self.source, self.dataset, self._mode
        with record_beside_rows(source, dataset, mode, earlier):
            self.batch = source.batch(missing)
            if not source.is_plain:
                store_sets(source, dataset, mode)
            if not self._is_described:
                dataset.define_fields(mode, source.fields)
                if streams is not None:
                    streams.begin()
                self._describe()
            if self.batch:
                dataset.append(mode, self.batch, checked=True)
        if streams is not None:
            streams.keep(source)

    def _check_batch_produce(self) -> None:
        """Call a replacement of `batch_produce`, which must store samples."""
        before = self.dataset.num_samples(self._mode)
        self.batch_produce()
        if self.dataset.num_samples(self._mode) == before:
            store = f"store them with self.dataset.append({self._mode!r}, ...)"
            raise self._lacks("batch_produce", "stored no samples", store)
        if not self._is_described:
            self._describe()

    def _describe(self) -> None:
        """Store with the samples which environment generated them."""
        described = describe_environment(self.environment_config, self._seed)
        self.dataset.update_info(**described)
        self._is_described = True

    def batch_count(self) -> None:
        """Count the batch."""
        self.batch_id += 1
        self.observers.advance(self.batch_size or 0)

    def batch_end(self) -> None:
        """Called after each batch."""

    def data_generation_end(self) -> None:
        """Called after the last batch."""

    def _begin(self) -> None:
        self._first_row += self.batch_id * (self.batch_size or 0)
        self.batch_id = 0
        if self._writer is not None:
            self._writer.failed = 0
            if isinstance(self._writer.queue, RowQueue):
                self._writer.queue.goal = self._first_row + self._amount()[0]
        end_generation(self.dataset, GENERATION)

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
        self._writer = self._streams = self._states = None
        self._first_row = self.batch_id = self._former_rows = 0
        self._is_described = False
        resources.callback(self._close_states)
        self.dataset = resources.enter_context(open_own(self.session, dataset_config))
        campaign = former = None
        campaigns = Campaign.count(self.dataset, self._mode)
        if self.resume and self._stores_rows(dataset_config):
            former = StoredStreams.find(self.dataset, self._mode, others=campaigns > 0)
        is_begun = campaigns > 0 or self.dataset.num_samples(self._mode) > 0
        if self.resume and former is None and is_begun:
            campaign = Campaign.last(self.dataset, self._mode, config)
        self._open_environments(resources, config, dataset_config, campaign, former)

    def _open_environments(
        self,
        resources: contextlib.ExitStack,
        config: EnvironmentConfig,
        dataset_config: DatasetConfig,
        campaign: Campaign | None,
        former: Generation | None,
    ) -> None:
        """Open the environments, unless there is nothing left to simulate.

        Args:
            resources: Closes them.
            config: The environment.
            dataset_config: Who writes the samples.
            campaign: The episodes to go on with, if any.
            former: The streams to go on with, if any.
        """
        offset = self._offset() if former is None else former.offset
        if campaign is not None:
            self._seed, seed = campaign.environment["seed"], campaign.seed
        else:
            self._seed = choose_seed(config.seed) if former is None else former.seed
            seed = derive_seed(self._seed, self._mode, offset)
        self._record_config(self._seed, **self._larger_number())
        self._observe(resources, config)
        if campaign is not None:
            self._writer = self._make_writer(campaign)
            if self._writer.queue.is_done and self.episodes is not None:
                return
        resources.push(self._cut)  # once the environments are closed
        by_clients = dataset_config.writers == "clients"
        delegation = self.dataset.delegate(self._mode) if by_clients else None
        total = None if self.episodes is not None else self._amount()[0]
        skip = NOTHING
        if campaign is None and self._stores_rows(dataset_config):
            place = (self.session, self.dataset, self._mode)
            self._streams = StoredStreams(*place, config, self._seed, offset, former, total or 0)
            skip = self._streams.skip
            if former is not None and skip.rows >= (total or 0):
                return
        elif campaign is None:
            remove_unused_parameters(self.dataset)
        known = self._streams
        self.source = self._open_source(
            *(resources, config, seed),
            total=total,
            skip=skip,
            delegation=delegation,
            keeps_pasts=self._streams is not None,
            touch=None if known is None else known.touched(self.observers.touch),
        )
        if campaign is None and self._simulates_episodes():
            self._begin_campaign(config, seed)
        if self._writer is not None:
            self._describe()
            self._writer.open(self.source, delegation)
        else:
            if delegation is not None:
                reject_streams_of_writers(describe_environment_config(config))
            self._check_streams()

    def _check_streams(self) -> None:
        """Check that nothing is asked for that only independent episodes have."""
        reject_episode_fields(self.source)
        if self.max_failed:
            name = describe_environment_config(self.environment_config)
            raise ConfigError(
                f"DataGeneration.max_failed is for independent episodes, but {name} is a stream: "
                "leave it out."
            )

    def _begin_campaign(self, config: EnvironmentConfig, seed: list[int]) -> None:
        """Simulate episodes by number, instead of streams."""
        self.source.check_independent()
        parameters, self._streams = self.source.sets.parameters, None
        forget_parameters(self.dataset.directory)
        self.dataset.update_info(**{STREAMS: None})
        campaign = Campaign.begin(self.dataset, self._mode, config, self._seed, seed, parameters)
        self._writer = self._make_writer(campaign)

    def _close_states(self) -> None:
        for kept in (self._streams, self._states):
            if kept is not None:
                kept.close()

    def _larger_number(self) -> dict[str, int]:
        """Return how much to record if the campaign was to have more than this run asks for."""
        file = self.session.path / "config.toml"
        former = read_toml(file).get(self.kind) if self.resume and file.exists() else None
        known = former if isinstance(former, dict) else {}
        mode = known.get("mode") or known.get("dataset", {}).get("mode", "training")
        if mode != self._mode:
            return {}
        if self.episodes:
            return {"episodes": max(int(known.get("episodes", 0)), self.episodes)}
        batches = {name: int(known.get(name, 0)) for name in ("batch_nb", "batch_size")}
        self._former_rows = math.prod(batches.values())
        return batches if self._former_rows > self._amount()[0] else {}

    def _offset(self) -> int:
        """Return how many rows or campaigns there are already, which get other random numbers."""
        return max(self.dataset.num_samples(self._mode), Campaign.count(self.dataset, self._mode))

    def _make_writer(self, campaign: Campaign) -> CampaignWriter:
        ended = campaign.ended(self.dataset, failed=not self.retry_failed)
        config = self.environment_config
        self._states, begun = find_begun(self.session, self.dataset, campaign, config)
        queue: EpisodeQueue
        if self.episodes is None:
            queue = RowQueue(self._amount()[0], ended, config.retries, begun)
        else:
            queue = EpisodeQueue(self.episodes, ended.all_numbers, config.retries, begun)
        return CampaignWriter(
            self.dataset,
            campaign,
            queue,
            self.max_failed,
            keeps_rejected=config.record_wrong_samples,
            states=self._states,
        )

    def _simulates_episodes(self) -> bool:
        """Return whether episodes are simulated by number, instead of streams."""
        return self.episodes is not None or (
            self.source.is_independent and self._is_own(DataGeneration.batch_produce)
        )

    def _stores_rows(self, dataset_config: DatasetConfig) -> bool:
        """Return whether the pipeline itself stores the rows of batches."""
        is_own = self._is_own(DataGeneration.batch_produce)
        return self.episodes is None and is_own and dataset_config.writers == "server"

    def _plan(self) -> Iterable[str]:
        former = Path(self.session_dir) / self.session_name
        if self._writer is not None and self.session.is_new and former != self.session.path:
            yield f"to go on with the episodes of {former}: --resume"

    def _results(self, error: BaseException | None) -> Iterable[str]:
        duration = self._duration
        if self.episodes is not None:
            writer = self._writer
            finished = 0 if writer is None else writer.queue.finished
            failed = f", of which {writer.failed} failed" if writer and writer.failed else ""
            yield f"{finished} of {self.episodes} episodes{failed} in {duration:.2f} s"
            yield describe_samples(self.dataset.directory)
            return
        count = self.batch_id
        rate = max(self._rows, 0) / duration
        yield f"{count} of {self.batch_nb} batches in {duration:.2f} s, {rate:.0f} samples/s"
        yield describe_samples(self.dataset.directory)
        if self._writer is not None and self._writer.failed:
            yield f"{self._writer.failed} episodes failed"

    def _findings(self) -> dict[str, Any]:
        rate = self._rows / self._duration if self._rows > 0 else 0.0
        return {"numbers": {"generated samples per s": rate} if rate else {}}

    def _next(self, error: BaseException | None) -> Iterable[str]:
        path = shlex.quote(str(self.session.path))
        if error is not None and (self._writer is not None or self._streams is not None):
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
