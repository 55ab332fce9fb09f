"""DataGeneration: environments generate samples, and the dataset stores them."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import ClassVar

from physx_core.config import MODES, WRONG, DatasetConfig, EnvironmentConfig, at_least, options
from physx_core.dataset import Dataset
from physx_core.errors import ConfigError, listed
from physx_core.pipelines.pipeline import NewSessionPipeline, choose_seed, derive_seed
from physx_core.pipelines.run_description import (
    describe_dataset,
    describe_environment_config,
    describe_failed_sets,
    describe_samples,
)
from physx_core.pipelines.storage import (
    check_client_writers,
    describe_environment,
    end_generation,
    open_own,
    record_beside_rows,
    store_sets,
)
from physx_core.sources.source import Source
from physx_core.typing import Batch


@options
@dataclass(eq=False)
class DataGeneration(NewSessionPipeline):
    """Generates ``batch_nb`` batches of ``batch_size`` samples and stores them in its session.

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
    batch_nb: int = at_least(1)
    """Number of batches to generate."""
    batch_size: int = at_least(1)
    """Number of samples in a batch."""
    mode: str | None = field(default=None, metadata={"choices": MODES})
    """Mode to store the samples in; None: `DatasetConfig.mode`."""

    kind: ClassVar[str] = "data_generation"
    dataset: Dataset = field(init=False, repr=False)
    source: Source = field(init=False, repr=False)
    batch: Batch = field(init=False, repr=False)
    batch_id: int = field(init=False, repr=False, default=0)
    _seed: int = field(init=False, repr=False, default=0)
    _mode: str = field(init=False, repr=False, default="")

    def execute(self) -> None:
        """Generate all batches.

        Raises:
            PhysxError: If an environment fails or sets data that cannot be stored; committed
                samples are kept.
        """
        with self._running():
            self.observers.begin("generation", self.batch_nb * self.batch_size, "samples")
            self.data_generation_begin()
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
            self.data_generation_end()

    def data_generation_begin(self) -> None:
        """Called before the first batch."""

    def batch_condition(self) -> bool:
        """Return whether there are batches left to generate."""
        return self.batch_id < self.batch_nb

    def batch_begin(self) -> None:
        """Called before each batch."""

    def batch_produce(self) -> None:
        """Generate a batch and store it; the samples are committed when this returns.

        With ``record_wrong_samples``, the samples that `check_sample` rejected are stored too, in
        the mode "wrong".
        """
        source, dataset, mode = self.source, self.dataset, self._mode
        with record_beside_rows(source, dataset, mode):
            self.batch = source.batch(self.batch_size)
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
        self.observers.advance(self.batch_size)

    def batch_end(self) -> None:
        """Called after each batch."""

    def data_generation_end(self) -> None:
        """Called after the last batch."""

    def _begin(self) -> None:
        self.batch_id = 0
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
        if dataset_config.writers == "clients":
            check_client_writers(config)
        if self._mode == WRONG:
            raise ConfigError(
                'The mode "wrong" is for samples that check_sample rejects. Generate samples for '
                f"{listed(MODES)}, with record_wrong_samples=True to keep the rejected ones."
            )
        seed = choose_seed(config.seed)
        self.session = self._create_session()
        self.dataset = resources.enter_context(open_own(self.session, dataset_config))
        offset = self.dataset.num_samples(self._mode)
        self._seed = seed
        self._record_config(seed)
        self._observe(resources, config)
        stripes = None
        if dataset_config.writers == "clients":
            stripes = self.dataset.stripes(self._mode, config.num_clients)
        self.source = self._open_source(
            resources,
            config,
            derive_seed(seed, self._mode, offset),
            total=self.batch_nb * self.batch_size,
            stripes=stripes,
        )

    def _results(self, error: BaseException | None) -> Iterable[str]:
        count, duration = self.batch_id, self._duration
        rate = count * self.batch_size / duration
        yield f"{count} of {self.batch_nb} batches in {duration:.2f} s, {rate:.0f} samples/s"
        yield describe_samples(self.dataset.directory)
        yield from describe_failed_sets(self.source)

    def _next(self, error: BaseException | None) -> Iterable[str]:
        path = shlex.quote(str(self.session.path))
        yield f"physx info {path}"
        if error is None and self._mode == "training":
            options = "--network.network NETWORK --epoch-nb N --batch-size N"
            yield f"physx train {path} {options}"

    def _components(self) -> Mapping[str, str]:
        return {
            "environment": describe_environment_config(self.environment_config),
            "dataset": describe_dataset(self.dataset),
        }
