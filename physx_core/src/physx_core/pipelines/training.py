"""Training: a network learns from a dataset, or from environments that make it."""

from __future__ import annotations

import contextlib
import statistics
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from physx_core import checkpoint
from physx_core.checkpoint import Progress
from physx_core.config import DatasetConfig, EnvironmentConfig, NetworkConfig, at_least, options
from physx_core.dataset import Dataset
from physx_core.errors import ConfigError
from physx_core.fields import Batch
from physx_core.pipelines.interrupt import deferred_interrupt
from physx_core.pipelines.learner import Learner
from physx_core.pipelines.pipeline import Pipeline, chosen_seed, stream_seed
from physx_core.pipelines.storage import describe_environment, open_existing, open_own
from physx_core.pipelines.training_data import TrainingData
from physx_core.plugins import resolve
from physx_core.session import Session
from physx_core.sources.source import Source


@options
@dataclass(eq=False)
class Training(Pipeline):
    """Trains a network for ``epoch_nb`` epochs of ``batch_nb`` batches of ``batch_size`` samples.

    The samples come from an existing dataset (``dataset_config.existing_dir``), from the session's
    own one, or from environments: these make new samples in the first epoch, which are stored and
    used again in the later ones, or in every epoch with ``always_produce``.

    Attributes:
        learner: The network, its transformation and its optimization.
        data: Where the batches come from.
        batch: The present batch, in physical units.
        epoch_id: Number of epochs that are finished.
        batch_id: Number of batches of the present epoch that are finished.
        losses: What `Optimization.transform_loss` returned for the present batch.
        training_loss: Mean loss over the batches of the last epoch; NaN before its end.
        validation_loss: Mean loss over the samples to validate with; NaN before the first time.
        checkpoint_path: Folder of the checkpoint that was written last.
    """

    network_config: NetworkConfig
    dataset_config: DatasetConfig | None = None
    environment_config: EnvironmentConfig | None = None
    session_dir: str = "sessions"
    """Folder of the sessions, relative to the working directory."""
    session_name: str = "training"
    """Name of the session's folder."""
    new_session: bool = True
    """Leave an existing session of this name alone and number the new one; otherwise use it."""
    _: KW_ONLY
    epoch_nb: int = at_least(1)
    """Number of epochs."""
    batch_size: int = at_least(1)
    """Number of samples in a batch."""
    batch_nb: int | None = at_least(1, None)
    """Batches in an epoch; None: as many as it takes to see each stored sample once."""
    seed: int | None = at_least(0, None)
    """Seed of the network's first parameters and of the order of samples; None: a fresh one."""
    validation_every: int = at_least(0, 1)
    """Validate after each so many epochs, if the dataset has a validation mode or
    `validation_split` holds samples back; 0: never."""
    resume: bool = field(default=False, metadata={"recorded": False})
    """Go on from the session's last checkpoint, until `epoch_nb` epochs are made in all."""

    kind: ClassVar[str] = "training"
    learner: Learner = field(init=False, repr=False)
    data: TrainingData = field(init=False, repr=False)
    batch: Batch = field(init=False, repr=False)
    epoch_id: int = field(init=False, repr=False, default=0)
    batch_id: int = field(init=False, repr=False, default=0)
    losses: dict[str, Any] = field(init=False, repr=False, default_factory=dict)
    training_loss: float = field(init=False, repr=False, default=float("nan"))
    validation_loss: float = field(init=False, repr=False, default=float("nan"))
    checkpoint_path: Path | None = field(init=False, repr=False, default=None)

    def execute(self) -> None:
        """Train. Ctrl-C ends the training after the present batch, with a checkpoint to resume.

        Raises:
            PhysxError: Data, network or environments are not what the training needs.
            KeyboardInterrupt: Ctrl-C; a second one ends the training at once.
        """
        with self._running(), deferred_interrupt() as interrupted:
            self.train_begin()
            while self.epoch_condition():
                self.epoch_begin()
                while self.batch_condition():
                    self.batch_begin()
                    self.batch_produce()
                    self.optimize()
                    self.batch_count()
                    self.batch_end()
                    if interrupted() and self.batch_condition():
                        self._end_early()
                self.epoch_count()
                self.epoch_end()
                if interrupted():
                    self._end_early()
            self.train_end()

    def train_begin(self) -> None:
        """The first epoch is about to begin, or that in which a resumed training ended."""
        self.epoch_id = self._resumed.epoch

    def epoch_condition(self) -> bool:
        """Return whether there are epochs left."""
        return self.epoch_id < self.epoch_nb

    def epoch_begin(self) -> None:
        """An epoch is about to begin."""
        begins = self.epoch_id == self._resumed.epoch
        self.batch_id = self._resumed.batch if begins else 0
        self._losses_of_epoch: list[float] = []
        self._epoch_batches = self.data.begin_epoch(self.epoch_id, self.learner.batch_fields)
        if begins:
            self.data.skip(self._resumed.batches_read)
            left = (self.epoch_nb - self.epoch_id) * self._epoch_batches - self.batch_id
            self.observers.begin("training", max(0, left), "batches")

    def batch_condition(self) -> bool:
        """Return whether there are batches left in the present epoch."""
        return self.batch_id < self._epoch_batches

    def batch_begin(self) -> None:
        """A batch is about to be made or read."""

    def batch_produce(self) -> None:
        """Read the next batch, or have the environments make and the dataset store it."""
        self.batch = self.data.next_batch()
        if self.data.produces:  # the normalization grows with the samples
            self.learner.bind(self.data.fields, self.data.normalization())
            self.learner.network.set_train()

    def optimize(self) -> None:
        """Let the network learn from the batch."""
        self.losses = self.learner.optimize(self.batch)

    def batch_count(self) -> None:
        """Count the batch and record its losses."""
        self.batch_id += 1
        self._losses_of_epoch.append(self.losses["loss"])
        values = {f"{name}/batch": value for name, value in self.losses.items()}
        number = self.epoch_id * self._epoch_batches + self.batch_id
        self.observers.scalars(values, number, "batch")
        self.observers.advance(1)

    def batch_end(self) -> None:
        """A batch is learned."""

    def epoch_count(self) -> None:
        """Count the epoch."""
        self.epoch_id += 1
        self.batch_id = 0

    def epoch_end(self) -> None:
        """Validate, record the epoch's losses, and keep a checkpoint if that is wanted."""
        if self._losses_of_epoch:
            self.training_loss = statistics.fmean(self._losses_of_epoch)
        values = {"loss/training": self.training_loss}
        every = self.validation_every
        if every and self.epoch_id % every == 0 and self.data.has_validation:
            self.validation_loss = values["loss/validation"] = self.validate()
        self.learner.epoch_end()
        self.observers.scalars(values, self.epoch_id, "epoch")
        if self.network_config.save_each_epoch and self.epoch_id < self.epoch_nb:
            self.save_checkpoint()

    def train_end(self) -> None:
        """The last epoch is over: keep the network."""
        self.observers.end()
        self.save_checkpoint()

    def validate(self) -> float:
        """Return the mean loss over the samples to validate with."""
        return self.learner.mean_loss(self.data.validation_batches(self.learner.batch_fields))

    def save_checkpoint(self) -> Path:
        """Write the network into the session and return the checkpoint's folder."""
        progress = Progress(
            self.epoch_id, self.batch_id, self.data.batches_read, self._resumed.seed
        )
        self.checkpoint_path = self.learner.save(self.session.network_dir, progress)
        return self.checkpoint_path

    def _end_early(self) -> None:
        self.save_checkpoint()
        raise KeyboardInterrupt

    # Opening --------------------------------------------------------------------------------

    def _open(self, resources: contextlib.ExitStack) -> None:
        config = self.dataset_config or DatasetConfig()
        environment = self.environment_config
        if environment is not None and config.existing_dir is not None:
            raise ConfigError(
                "A training takes its samples from existing_dir or from an environment, not both."
            )
        last = self._last_checkpoint() if self.resume else None
        if last is not None:
            environment = self._environment_to_resume(last.progress)
        self._resumed = last.progress if last else Progress(0, 0, 0, chosen_seed(self.seed))
        self._seed_network(self._resumed.seed)
        self.learner = Learner(self.network_config, trains=True)
        if config.existing_dir is not None:  # a missing dataset leaves no session behind
            Dataset.open(config.existing_dir).close()
        new = self.new_session and not self.resume
        self.session = Session.create(self.session_dir, self.session_name, new)
        make = open_existing if environment is None else open_own
        dataset = resources.enter_context(make(self.session, config))
        self._record_config(self._resumed.seed)
        self._observe(resources, environment)
        source = None
        if environment is not None:
            source = self._open_environments(resources, environment, dataset)
        self.data = TrainingData(
            dataset,
            source,
            config,
            batch_size=self.batch_size,
            batch_nb=self.batch_nb,
            seed=self._resumed.seed,
            always_produce=environment is not None and environment.always_produce,
            data_type=self.network_config.data_type,
        )
        if source is None:
            self.learner.bind(self.data.fields, self.data.normalization())
        self._load_parameters(last)
        self.learner.network.set_train()

    def _last_checkpoint(self) -> checkpoint.Checkpoint:
        session = Session.existing(self.session_dir, self.session_name)
        name = self.network_config.network_name
        return checkpoint.read(checkpoint.find(session.network_dir, name, -1))

    def _environment_to_resume(self, progress: Progress) -> EnvironmentConfig | None:
        """Return None: all samples are stored already, or the training cannot be resumed."""
        environment = self.environment_config
        if environment is not None and (environment.always_produce or progress.epoch == 0):
            raise ConfigError(
                "A training cannot be resumed while environments make its samples: they would "
                "begin anew. Train on the stored samples: leave the environment out."
            )
        return None

    def _seed_network(self, seed: int) -> None:
        if self.network_config.network is not None:
            component = resolve("network", self.network_config.network)
            if hasattr(component, "set_seed"):
                component.set_seed(seed)

    def _load_parameters(self, last: checkpoint.Checkpoint | None) -> None:
        config = self.network_config
        if last is not None:
            self.learner.resume(last)
        elif config.network_dir is not None:
            place = Path(config.network_dir)
            path = checkpoint.find(place, config.network_name, config.which_network)
            self.learner.network.load_parameters(path / self.learner.network.parameters_file)

    def _open_environments(
        self, resources: contextlib.ExitStack, config: EnvironmentConfig, dataset: Dataset
    ) -> Source:
        seed = self._resumed.seed if config.seed is None else config.seed
        dataset.update_info(**describe_environment(config, seed))
        stored = dataset.num_samples("training") if "training" in dataset.modes else 0
        return self._open_source(
            resources,
            config,
            stream_seed(seed, "training", stored),
            predict=self.learner.predict_in_training,
        )
