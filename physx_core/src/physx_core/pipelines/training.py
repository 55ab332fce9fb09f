"""Training: trains a network on a dataset or on samples that environments generate."""

from __future__ import annotations

import contextlib
import math
import shlex
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

from physx_core import checkpoint
from physx_core.checkpoint import Progress
from physx_core.components.buffer import Buffer
from physx_core.components.group import Group
from physx_core.config import EnvironmentConfig, NetworkConfig, at_least, options, to_plain
from physx_core.dataset import Dataset
from physx_core.errors import ConfigError, DivergedError, PhysxError
from physx_core.observers import REPORT_SECONDS, statistics_observers
from physx_core.pipelines.learning.bound_options import bound_options, check_bound
from physx_core.pipelines.learning.data_record import (
    describe_batch,
    record_data,
    warn_of_changes,
)
from physx_core.pipelines.learning.judging import (
    NOT_JUDGED,
    Judging,
    Judgment,
    find_metrics,
    find_rivals,
)
from physx_core.pipelines.learning.learner import Learner
from physx_core.pipelines.learning.opening import DataOpening, join_group, open_dataset
from physx_core.pipelines.learning.resuming import Start, can_resume, find_start
from physx_core.pipelines.learning.training_data import TrainingData
from physx_core.pipelines.learning.training_record import BestEpoch, TrainingRecord
from physx_core.pipelines.learning.unrolling import Unrolling, open_unrolling
from physx_core.pipelines.pipeline import NewSessionPipeline, choose_seed
from physx_core.pipelines.run_description import (
    describe_samples,
    describe_training,
)
from physx_core.pipelines.storage import (
    check_sources,
    reject_client_writers,
    reject_environments,
)
from physx_core.plugins import create
from physx_core.processes import Interrupt, deferred_interrupt, is_from_signal
from physx_core.results import Result
from physx_core.results.errors import as_loss
from physx_core.results.judge import UNCHANGED
from physx_core.session import Session
from physx_core.typing import Batch
from physx_core.views.dataset_config import DatasetConfig
from physx_core.views.view import View

_ADVICE = (
    "Lower the learning rate, normalize the data (DatasetConfig.normalize) or limit the gradients; "
    'on_nan="continue" ignores this.'
)
_KEPT_WITHIN_EPOCHS = 2


@options
@dataclass(eq=False)
class Training(NewSessionPipeline):
    """Trains a network for ``epoch_nb`` epochs of ``batch_nb`` batches of ``batch_size`` samples.

    The samples come from

    - an existing dataset (``dataset_config.existing_dir``), which is only read, or the session's
      own dataset;
    - environments, which generate samples in the first epoch, stored and reused in later epochs, or
      in every epoch with ``always_produce``; ``online`` decides how batches are formed while they
      generate;
    - an existing dataset replayed through environments, with ``load_samples``: the session gets its
      own copy of the dataset; in the first epoch, or in every epoch with
      ``only_first_epoch=False``, each stored sample goes through an environment. The result is
      trained on and replaces the sample in the copy: see `TrainingData`. Without ``existing_dir``,
      the session's own samples are replayed.

    Several processes started by ``torchrun`` train one network together: each takes its share of
    every batch, whose size is ``batch_size`` times the number of processes. The first process
    writes the session, runs the environments, and passes each process its share of what they
    generate. If they replay samples in the first epoch, train that epoch in one process, then
    continue in several with ``resume``.

    Attributes:
        group: The processes that train together.
        learner: The network, its transformation and its optimization.
        data: Source of the batches.
        batch: The current batch, in physical units; while environments generate, only this
            process's share of it.
        epoch_id: Number of finished epochs.
        batch_id: Number of finished batches of the current epoch.
        losses: The result of `Optimization.transform_loss` for the current batch, as numbers.
        training_loss: Mean loss over the batches of the last epoch; NaN before the first one ends.
        validation_loss: Mean loss over the validation samples; NaN before the first validation.
        best: The epoch with the smallest loss, whose network is the checkpoint "best".
        checkpoint_path: Folder of the last checkpoint.
    """

    network_config: NetworkConfig
    """The network, its transformation and its optimization."""
    dataset_config: DatasetConfig | View | str | Path | None = None
    """The stored samples, and how they are read; a view, or the folder of a session or dataset, if
    nothing else is to be said of them. None: the session's own samples."""
    environment_config: EnvironmentConfig | None = None
    """The environment that generates samples, or replays stored ones; None: no environment."""
    _: KW_ONLY
    epoch_nb: int = at_least(1)
    """Number of epochs."""
    batch_size: int = at_least(1)
    """Number of samples in a batch; with several processes (torchrun), in each process's share."""
    batch_nb: int | None = at_least(1, None)
    """Batches in an epoch; None: as many as needed to use each stored sample once."""
    seed: int | None = at_least(0, None)
    """Seed of the network's initial parameters and of the order of samples; None: a random one."""
    online: str | type[Any] = "physx/stream"
    """Buffer that decides which rows a batch contains while environments generate them:
    "physx/stream" uses each row once, in order; "physx/reservoir", "physx/window" and "physx/fifo"
    draw batches at random from the rows kept in memory; or a plugin's buffer."""
    online_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the buffer: ``capacity``, number of rows kept in memory;
    ``watermark``, number of rows before the first batch; ``views``, average number of times that a
    row is used. All rows are stored, whether they are kept in memory or not."""
    run_ahead: int = at_least(1, 64)
    """For a sampler that learns: how many independent episodes may be simulated beyond the first
    missing one. The parameters of episode k depend on the losses of the batches made only of
    samples of episodes before ``k - run_ahead``."""
    max_failed: int = at_least(0, 0)
    """Number of independent episodes that may fail before the training fails."""
    unroll: Sequence[int] = ()
    """Number of steps in which the network learns from its own predictions, for each epoch; the
    last number holds for all further ones: [1, 2, 4]. A prediction that is the same quantity as an
    input, such as a later window of the same field, takes its place in the next step; the loss is
    that of all steps. Validations have one step. Empty: one step always."""
    noise: float = at_least(0, 0.0)
    """Standard deviation of noise on the inputs that are fed back so, in standard deviations of
    their normalization: the network learns to correct errors of that size."""
    validation_every: int = at_least(0, 1)
    """Number of epochs between validations, if the dataset has a validation mode or
    `View.hold_back` does; 0: never."""
    validation_batch_size: int | None = at_least(1, None)
    """Number of validation samples predicted at once, in each process; None: `batch_size`. It
    changes the memory and the time that a validation takes, but not its losses."""
    monitor: str | None = None
    """What decides which network is the "best", when `patience` ends, and what a scheduler such as
    "ReduceLROnPlateau" gets: an error on the validation samples in physical units, for example
    "error/FIELD/relative_l2", all of which are then recorded; see `FieldResult.errors`; or one of
    `metrics`, "metric/NAME". None: the validation loss, or if nothing is validated the training
    loss."""
    metrics: Sequence[str | Callable[..., Any]] = ()
    """Your own errors, measured in each validation and at the end, by "script.py:function" or
    "package.module:function". A function gets the predictions and the true values of one episode in
    physical units, arrays by the name of the true field, and returns a number, small if it is good;
    the mean over the episodes counts. The true values include the network's inputs."""
    patience: int | None = at_least(1, None)
    """Number of consecutive validations (epochs, if nothing is validated) without improvement of
    the loss after which to stop; None: never. The last network is kept in addition to "best"."""
    min_improvement: float = at_least(0, 0.0)
    """Smallest decrease below the best loss that counts as an improvement."""
    rivals: str | Sequence[str | Callable[..., Any]] = "all"
    """What the network is compared with at the end, on the samples that were held back: "all" are
    predictions that need no network, which get a tenth of the training's time: the mean, no change,
    a linear map, and the nearest sample. Your own are named as "script.py:function" or
    "package.module:function": ["all", "script.py:theory"]; a function gets the network's inputs in
    physical units by name, shape (rows, ...) each, and returns the prediction, or a table of them
    by the name of the true field. []: only the network's own errors; "none": these neither."""
    on_nan: str = field(default="stop", metadata={"choices": ("stop", "continue")})
    """What to do if a loss, gradient, or parameter is NaN or infinite: "stop" with an error and the
    previous checkpoint, or "continue" and ignore it."""
    statistics: Sequence[str | type[Any]] = ()
    """Observers that receive the statistics in addition to stats/scalars.csv, for example
    "torch/tensorboard" or "rerun"."""
    statistics_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of each observer, by its name; in a command ``rerun={mode="save"}``."""
    histograms_every: int = at_least(0, 0)
    """Number of epochs between histograms of weights and gradients; 0: none."""
    checkpoint_every: int | Literal["epoch"] = at_least(0, 0)
    """Number of batches between checkpoints within epochs, counted over all epochs; "epoch": one
    after the last batch of each epoch; 0: none. The last two of these are kept."""
    resume: bool = field(default=False, metadata={"recorded": False})
    """Resume from the session's last checkpoint, up to `epoch_nb` epochs in total. If environments
    were generating the samples, they go on with the independent episodes that are missing; streams
    generate the stored samples again, unless these depend on predictions. Without a checkpoint,
    training restarts with the stored samples."""

    kind: ClassVar[str] = "training"
    group: Group = field(init=False, repr=False, default_factory=Group)
    learner: Learner = field(init=False, repr=False)
    data: TrainingData = field(init=False, repr=False)
    batch: Batch = field(init=False, repr=False)
    epoch_id: int = field(init=False, repr=False, default=0)
    batch_id: int = field(init=False, repr=False, default=0)
    losses: dict[str, float] = field(init=False, repr=False, default_factory=dict)
    training_loss: float = field(init=False, repr=False, default=float("nan"))
    validation_loss: float = field(init=False, repr=False, default=float("nan"))
    _validates: bool = field(init=False, repr=False, default=False)
    best: BestEpoch = field(init=False, repr=False)
    checkpoint_path: Path | None = field(init=False, repr=False, default=None)
    _reported: float = field(init=False, repr=False, default=0.0)
    _within_epochs: list[Path] | None = field(init=False, repr=False, default=None)
    _epoch_batches: int | None = field(init=False, repr=False, default=None)
    _is_savable: bool = field(init=False, repr=False, default=False)
    _saw_nan: bool = field(init=False, repr=False, default=False)
    _fields_reported: bool = field(init=False, repr=False, default=False)
    _blocks: int = field(init=False, repr=False, default=0)
    _told: Sequence[str] = field(init=False, repr=False, default=())
    _recorded: dict[str, float] | None = field(init=False, repr=False, default=None)
    _batches_read: int = field(init=False, repr=False, default=0)
    _unrolling: Unrolling | None = field(init=False, repr=False, default=None)
    _judging: Judging = field(init=False, repr=False)
    _judgment: Judgment = field(init=False, repr=False, default=NOT_JUDGED)

    def __post_init__(self) -> None:
        """Store what was given in place of a configuration of the dataset as one."""
        given = self.dataset_config
        if isinstance(given, View):
            self.dataset_config = DatasetConfig(view=given)
        elif isinstance(given, (str, Path)):
            self.dataset_config = DatasetConfig(existing_dir=given)

    @property
    def _dataset_options(self) -> DatasetConfig:
        given = self.dataset_config
        return given if isinstance(given, DatasetConfig) else DatasetConfig()

    def execute(self) -> Result:
        """Train, and write a checkpoint to resume from however the training ends.

        Ctrl-C and SIGTERM end it after the current batch; a second signal ends it immediately,
        without a checkpoint. An error also ends it, and gets a note that names the checkpoint.

        Raises:
            DivergedError: If a loss, gradient, or parameter is not finite, with ``on_nan="stop"``.
            PhysxError: If data, network, or environments do not fit together, or fail.
            KeyboardInterrupt: After Ctrl-C.
            SystemExit: After SIGTERM, with status 143.
        """
        with self._running(), deferred_interrupt() as interrupt:
            self.train_begin()
            self._restore()
            while more := self.epoch_condition():
                self._begin_epoch()
                self.epoch_begin()
                while left := self.batch_condition():
                    self.batch_begin()
                    self.batch_produce()
                    if not self.batch:
                        raise self._lacks("batch_produce", "set no batch", "set self.batch")
                    self.losses = {}
                    self.optimize()
                    if not self.losses:
                        how = 'set self.losses = {"loss": ...}'
                        raise self._lacks("optimize", "set no losses", how)
                    self._count("batch_id", "batch_count")
                    if self._recorded is not self.losses:
                        self._record_batch()
                    self.batch_end()
                    self._leave_batch(interrupt)
                self._check_condition(left, "batch_condition")
                self._count("epoch_id", "epoch_count")
                self._finish_epoch()
                self.epoch_end()
                self._leave_epoch(interrupt)
            self._check_condition(more, "epoch_condition")
            self.train_end()
            self._finish()
            self._judge()
        return self.result

    def train_begin(self) -> None:
        """Called before the first epoch, or before the epoch at which training resumes.

        When a training resumes, its checkpoint is restored once more afterwards: what this method
        changes in the network, the optimization, or its loss has an effect only at the beginning.
        """

    def epoch_condition(self) -> bool:
        """Return whether there are epochs left and the training has not stopped early."""
        return self.epoch_id < self.epoch_nb and not self.stopped

    def _begin_epoch(self) -> None:
        """Prepare the epoch and determine its number of batches, unless that is done."""
        if self._epoch_batches is not None:
            return
        names = self.learner.batch_fields
        if self._unrolling is not None:
            self._unrolling.begin(self.epoch_id, self.batch_id)
        self._epoch_batches = self.data.begin_epoch(self.epoch_id, names, self.batch_id)
        if self.data.stored.has_changed:
            self.learner.normalize(self.data.normalization())
        if self.epoch_id == self._resumed.epoch:
            self._batches_read = self.data.stored.count
            left = (self.epoch_nb - self.epoch_id) * self._epoch_batches - self.batch_id
            self.observers.begin(f"{self.epoch_nb} epochs", max(0, left), "batches")

    def epoch_begin(self) -> None:
        """Called before each epoch, when its batches are prepared."""

    def batch_condition(self) -> bool:
        """Return whether there are batches left in the current epoch."""
        if self._epoch_batches is None:
            self._begin_epoch()
        return self.batch_id < (self._epoch_batches or 0)

    def batch_begin(self) -> None:
        """Called before each batch."""

    def batch_produce(self) -> None:
        """Read the next batch, or have the environments generate it and the dataset store it."""
        if self._epoch_batches is None:
            self._begin_epoch()
        self.batch = self.data.next_batch()
        if self.data.generated is not None:  # the normalization grows with the samples
            self.learner.bind(self.data.fields, self.data.normalization())
            self.learner.network.set_train()

    def optimize(self) -> None:
        """Train the network on the batch; after the first batch, check that it can be saved.

        Raises:
            DivergedError: If the loss or a gradient is not finite, with ``on_nan="stop"``.
        """
        made = self.data.generated
        weight, by_row = (None, False) if made is None else (made.weight, made.learns)
        try:
            self.losses = self.learner.optimize(self.batch, weight, by_row=by_row)
        except DivergedError as error:
            raise self._diverged(f"{error}", self.batch_id + 1) from None
        if made is not None and by_row:
            made.tell(self.batch, self.learner.row_losses)
        if self.on_nan == "continue" and not math.isfinite(self.losses["loss"]):
            self._continue_after_nan()
        if self._is_main and not self._is_savable:
            self.learner.dry_run_save(self.session.path)
            self._is_savable = True

    def batch_count(self) -> None:
        """Count the batch and record its losses."""
        self.batch_id += 1
        self._record_batch()

    def _record_batch(self) -> None:
        """Record the batch's losses."""
        self._recorded, self._batches_read = self.losses, self.data.stored.count
        self._record.add(self.epoch_id * (self._epoch_batches or 0) + self.batch_id, self.losses)
        now = time.monotonic()
        if now > self._reported + REPORT_SECONDS or self.data.generated is not None:
            self._reported = now
            self._report()
            if self._is_main:
                checkpoint.check_session(self.session.network_dir)

    def _report(self) -> None:
        """Pass the losses of the batches since the last report to the observers."""
        batches, online = self._record.take_batches(), {}
        if not batches:
            return
        if not self._fields_reported:
            self.observers.fields(list(self.learner.fields.values()))
            self._fields_reported = True
        if self.data.generated is not None and self.data.online is not None:
            self._blocks = self.data.online.number
            online = self.data.online.recent_statistics()
        for number, values in batches:
            self.observers.scalars(values | online, number, "batch")
        self.observers.advance(len(batches))

    @property
    def _number(self) -> int:
        """Number of finished batches of all epochs."""
        return self.epoch_id * (self._epoch_batches or 0) + self.batch_id

    def batch_end(self) -> None:
        """Called after each batch."""

    def epoch_count(self) -> None:
        """Count the epoch, validate, and record its losses."""
        self.epoch_id += 1
        self._finish_epoch()

    def _finish_epoch(self) -> None:
        """Validate, record the epoch's losses, and note the best network, unless that is done."""
        if self._epoch_batches is None:
            return
        self._report()
        self.data.end_epoch()
        self._epoch_batches, self.batch_id = None, 0
        values = self._record.take_epoch()
        self.training_loss = values.get("loss/training", float("nan"))
        if self.learner.learning_rate is not None:
            values["learning_rate"] = self.learner.learning_rate
        every, judged = self.validation_every, self.training_loss
        is_due = not self._validates or self.epoch_id % every == 0
        if self._validates:
            judged = self._validate(values) if is_due else float("nan")
        self.observers.scalars(values, self.epoch_id, "epoch")
        if self.histograms_every and self.epoch_id % self.histograms_every == 0:
            self.observers.histograms(self.learner.distributions(), self.epoch_id, "epoch")
        if is_due and self.best.update(judged, self.epoch_id):
            wanted = self.network_config.save_best
            if wanted or (wanted is None and (self._validates or self.patience is not None)):
                self._write(best=True)
        try:
            self.learner.epoch_end(judged)
        except DivergedError as error:
            raise self._diverged(f"{error}", 0) from None

    def epoch_end(self) -> None:
        """Called after each epoch, when its losses are known; before its checkpoint is written."""

    def _leave_epoch(self, interrupt: Interrupt) -> None:
        """Write a checkpoint if one is due; after a signal, end."""
        if self.network_config.save_each_epoch and self.epoch_id < self.epoch_nb:
            self.save_checkpoint()
        if self.group.any(bool(interrupt)):
            self._end_early(interrupt)

    def _validate(self, values: dict[str, float]) -> float:
        losses = self.validate()
        values |= {f"{name}/validation": value for name, value in losses.items()}
        self.validation_loss = losses["loss"]
        if self.observers.want_predictions:
            samples = self.data.stored.validation_samples(self.learner.batch_fields)
            compared = self.learner.compare(samples, self.validation_batch_size or self.batch_size)
            self.observers.predictions(*compared, self.epoch_id, "epoch")
        if self.on_nan == "stop" and not math.isfinite(self.validation_loss):
            raise self._diverged(f"the validation loss is {self.validation_loss}", 0)
        errors = self._judging.measure() if self._judging.measures else {}
        values |= errors
        return self._judging.deciding(errors, self.validation_loss)

    def train_end(self) -> None:
        """Called after the last epoch; before the last checkpoint is written."""

    def _finish(self) -> None:
        """Write the last checkpoint and report an early stop."""
        self.observers.end()
        if self.stopped and self._is_main:
            self.observers.note(self.stopped)
            self.session.note(self.stopped)
        self.save_checkpoint()

    def _judge(self) -> None:
        """Measure how good the network is, unless that is not wanted."""
        if self._is_main and self._judging.judges:
            self._judgment = self._judging.judge(self._duration, self._decided)

    @property
    def _decided(self) -> str:
        """What the validation samples decided about the last network, in words."""
        scheduler = self.network_config.scheduler
        name = scheduler if isinstance(scheduler, str) else getattr(scheduler, "__name__", "")
        decided = (
            ["when the training stopped"] if self.patience is not None and self._validates else []
        )
        decided += ["the learning rate"] if "Plateau" in name and self._validates else []
        return " and ".join(decided)

    @property
    def _decisive(self) -> str:
        """What decides which network is the best."""
        return self.monitor or f"{'validation' if self._validates else 'training'} loss"

    @property
    def stopped(self) -> str:
        """Why the training ends before its last epoch; empty if it does not."""
        if self.patience is None or self.epoch_id >= self.epoch_nb:
            return ""
        return self.best.reason_to_stop(self.patience, self._decisive)

    def validate(self) -> dict[str, float]:
        """Return the mean loss and other statistics over the validation samples."""
        batches = self.data.stored.validation_batches(self.learner.batch_fields)
        return self.learner.mean_losses(batches)

    def save_checkpoint(self) -> Path:
        """Write the network into the session and return the checkpoint's folder.

        If no batch was trained since the last checkpoint, no new one is written.

        Raises:
            DivergedError: If a parameter is not finite, with ``on_nan="stop"``; nothing is written.
            CheckpointError: If it cannot be stored.
        """
        now = (self.epoch_id, self.batch_id)
        if self.checkpoint_path is None or self._saved != now:
            self.checkpoint_path = self._write()
            self._saved: tuple[int, int] = now
        return self.checkpoint_path

    def _write(self, *, best: bool = False) -> Path:
        self._check_parameters()
        written = str(self._write_own(best=best)) if self._is_main else None
        return Path(self.group.broadcast(written))

    def _write_own(self, *, best: bool = False) -> Path:
        self._report()
        self.observers.flush()
        progress = Progress(
            self.epoch_id,
            self.batch_id,
            self._batches_read,
            self._resumed.seed,
            self._blocks,
            self.best.state,
            self._record.state,
            self.data.stored.snapshots,
            self._last_batch(),
            bound_options(self, self._resumed.seed, self.group.size),
            self._data_record(),
        )
        generated = self.data.generated
        states = generated.states(self._blocks) if generated is not None else ()
        return self.learner.save(self.session.network_dir, progress, *states, best=best)

    def _last_batch(self) -> dict[str, Any]:
        """Return what shows later that the last stored batch was the same, if there is one."""
        read, stored = self._batches_read, self.data.stored
        if read == self._resumed.batches_read:
            return self._resumed.last_batch
        names, batch = self.learner.batch_fields, self.batch
        if stored.count != read:
            try:
                batch = stored.read(read - 1, names)
            except PhysxError:  # perhaps why the training ends; its network is kept all the same
                return {}
        if self.group.size > 1 or not batch.keys() >= set(names):
            return {}
        return describe_batch(read - 1, batch, names)

    def _leave_batch(self, interrupt: Interrupt) -> None:
        """Write a checkpoint if one is due; after a signal, end within the epoch."""
        every = self._epoch_batches if self.checkpoint_every == "epoch" else self.checkpoint_every
        if every and self._number % every == 0:
            self._save_within_epoch()
        ends = self.group.any(bool(interrupt)) if self.group.size > 1 else interrupt
        if ends and self.batch_condition():
            self._end_early(interrupt)

    def _save_within_epoch(self) -> None:
        """Write a checkpoint, then remove all earlier ones within epochs except the previous one.

        The previous one is kept in case the new one gets damaged on the disk.
        """
        if not self._is_main:
            self.save_checkpoint()
            return
        if self._within_epochs is None:  # find those of earlier runs
            name = self.network_config.network_name or checkpoint.NAME
            self._within_epochs = checkpoint.list_within_epochs(self.session.network_dir, name)
        path = self.save_checkpoint()
        if path not in self._within_epochs:
            self._within_epochs.append(path)
        while len(self._within_epochs) > _KEPT_WITHIN_EPOCHS:
            checkpoint.remove(self._within_epochs.pop(0))

    def _end_early(self, interrupt: Interrupt) -> None:
        self.save_checkpoint()
        interrupt.end()

    def _save_after(self, error: BaseException) -> None:
        """Save the network trained so far, and add its location to the error as a note.

        Other processes of the group may have failed, so nothing is exchanged with them.
        """
        now = (self.epoch_id, self.batch_id)
        if not self._is_main or now == (self._resumed.epoch, self._resumed.batch):
            return
        try:
            if self._saved != now:
                self._check_parameters()
                self.checkpoint_path, self._saved = self._write_own(), now
        except Exception as failure:
            last = self.checkpoint_path or "none; save_each_epoch=True writes one after each epoch"
            error.add_note(f"The network could not be saved: {failure} Last checkpoint: {last}.")
        else:
            how = "resume=True (physx train --resume) continues from it"
            if not self._is_resumable:
                how = "NetworkConfig.network_dir starts another training from it"
            error.add_note(f"The network trained so far is {self.checkpoint_path}; {how}.")

    @property
    def _is_resumable(self) -> bool:
        """Whether the training can be resumed from the last checkpoint."""
        return self.data.repeats or can_resume(self.environment_config, self.epoch_id)

    def _check_parameters(self) -> None:
        name = self.learner.network.find_not_finite() if self.on_nan == "stop" else ""
        if name:
            raise self._diverged(f'the parameter "{name}" holds NaN or infinity', self.batch_id)

    def _diverged(self, what: str, batch: int) -> DivergedError:
        epoch = self.epoch_id + (batch > 0)
        return DivergedError(f"{what}. {_ADVICE}", epoch=epoch, batch=batch)

    def _continue_after_nan(self) -> None:
        """Report once that training continues although a loss is not finite."""
        if self._is_main and not self._saw_nan:
            text = (
                f"Epoch {self.epoch_id + 1}, batch {self.batch_id + 1}: the loss is "
                f'{self.losses["loss"]}; the training continues (on_nan="continue").'
            )
            self.observers.note(text)
            self.session.note(text)
        self._saw_nan = True

    def _close(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        """Keep what was trained since the last checkpoint, by `execute` or by a user's own loop."""
        with deferred_interrupt():
            self._report()
            if error is not None and not is_from_signal(error):
                self._save_after(error)
            elif error is None and self._saved != (self.epoch_id, self.batch_id):
                self._finish()

    # Opening --------------------------------------------------------------------------------

    def _open(self, resources: contextlib.ExitStack) -> None:
        start = Start(self._dataset_options, self.environment_config)
        check_sources(start.config, start.environment)
        reject_client_writers(start.config, "a training")
        self.group, network_class = join_group(self.network_config)
        self._is_main = self.group.is_main
        if self.group.size > 1 and start.environment is not None and not self.resume:
            reject_environments(start.environment)
        if self.resume:
            session = Session.existing(self.session_dir, self.session_name)
            name = self.network_config.network_name or checkpoint.NAME
            start = find_start(session, name, start.environment, start.config)
        self._begin_at(start)
        if start.checkpoint is not None and start.session is not None:
            self._check_resumed(start.session.path)
        buffer = self._create_buffer()
        metrics, rivals = find_metrics(self.metrics), find_rivals(self.rivals)
        network_class.set_seed(self._resumed.seed)
        self.learner = Learner(self.network_config, trains=True, stops_at_nan=self.on_nan == "stop")
        existing = start.config.existing_dir
        for folder in (*start.config.view.sources, *([] if existing is None else [existing])):
            Dataset.open(folder).close()  # fail before a session is created
        self.session = start.session or self._open_session()
        dataset = resources.enter_context(open_dataset(self.session, start, self.group))
        self._record_config(self._resumed.seed)
        further = statistics_observers(self.statistics, self.statistics_kwargs, start.environment)
        self._observe(resources, start.environment, further if self._is_main else ())
        opening = DataOpening(
            start,
            self.session,
            self.group,
            buffer,
            self._resumed,
            batch_nb=self.batch_nb,
            validation_batch_size=self.validation_batch_size,
            batch_fields=self.learner.batch_fields,
            data_type=self.network_config.data_type,
            ahead=type(self).batch_condition is Training.batch_condition
            and type(self).batch_produce is Training.batch_produce,
            open_source=partial(self._open_source, resources),
            predict=self._predict,
            show=self.observers.events,
            run_ahead=self.run_ahead,
            max_failed=self.max_failed,
        )
        self.data = opening.open(resources, dataset)
        self._unrolling = open_unrolling(
            *(self.unroll, self.noise, self.learner, self.data.stored),
            *(start.environment, self._resumed.seed),
        )
        self._prepare_learner(start)
        if self._unrolling is not None:
            self._unrolling.check(self.data.stored, self.learner.transformation)
        self._validates = self.validation_every > 0 and self.data.stored.has_validation
        of = self.learner, self.data.stored
        self._judging = Judging(*of, self.monitor, metrics, rivals, validates=self._validates)
        if start.checkpoint is not None and start.environment is None and self._is_main:
            fixed, folder = self._resumed.snapshots, self.data.dataset.directory
            data = self._resumed.data, self.data.stored.datasets, start.config.mode, fixed
            if text := warn_of_changes(folder, *data):
                self.session.note(text)
        resources.push(self._close)

    def _begin(self) -> None:
        self.epoch_id, self.batch_id = self._resumed.epoch, self._resumed.batch
        self._epoch_batches, self.batch = None, {}

    def _check_resumed(self, session: Path) -> None:
        """Check that the options are those of the checkpoint, as far as it depends on them."""
        seed = self._resumed.seed if self.seed is None else self.seed
        now = bound_options(self, seed, self.group.size)
        check_bound(session, self._resumed.options, now)

    def _data_record(self) -> dict[str, Any]:
        """Return what identifies the data; nothing while they are replaced by a replay."""
        environment = self.environment_config
        if environment is not None and environment.load_samples:
            return {}
        return record_data(self.data.stored.datasets, self._dataset_options.mode)

    def _begin_at(self, start: Start) -> None:
        """Start at the first batch, or where a checkpoint was written."""
        former, last = start.generation, start.checkpoint
        seed = self.group.broadcast(choose_seed(self.seed) if former is None else former.seed)
        self._resumed = last.progress if last else Progress(0, 0, 0, seed)
        self._resumed_from = last
        self._saved = (self._resumed.epoch, self._resumed.batch)
        self._blocks = self._resumed.blocks
        self.checkpoint_path = last.path if last else None
        self._record = TrainingRecord(self._resumed.record)
        self.best = BestEpoch(self._resumed.best, self.min_improvement)

    def _create_buffer(self) -> Buffer:
        environment = self.environment_config
        buffer: Buffer = create("buffer", self.online, self.online_kwargs)
        produces = environment is not None and not environment.load_samples
        if not produces and buffer.capacity and not self.resume:
            raise ConfigError(
                f"Training.online is {self.online!r}, which mixes rows while environments generate "
                "them, but none do here: name an environment that does, or leave online out."
            )
        always = environment is not None and environment.always_produce
        batch_nb = (self.batch_nb or 0) * (self.epoch_nb if always else 1)
        buffer.begin(self.batch_size * self.group.size, batch_nb, self._resumed.seed)
        return buffer

    def _open_session(self) -> Session:
        made = None
        if self._is_main:
            made = self._create_session()
        path = Path(self.group.broadcast(made and str(made.path)))
        return made or Session(path)

    def _prepare_learner(self, start: Start) -> None:
        """Bind the network to the data, and load its parameters."""
        data, last = self.data, start.checkpoint
        fields = data.fields
        shapes = [fields[name].shape for name in self.learner.batch_fields if name in fields]
        if data.generated is None or None not in shapes:  # else bound with the first batch
            known = data.normalization()
            replays = self.environment_config is not None and self.environment_config.load_samples
            if last is not None and not replays:
                known = last.normalization  # bit-identical, whatever was appended since
            self.learner.bind(fields, known)
        self._told = self.learner.begin(self.epoch_nb, data.batches_per_epoch)
        self._load_parameters(last)
        self.learner.join(self.group)
        self.learner.network.set_train()

    def _restore(self) -> None:
        """Undo what an overridden `train_begin` has changed in a training that resumes.

        Else a resumed training would differ from an uninterrupted one, in which it ran only once.
        """
        last, is_own = self._resumed_from, type(self).train_begin is not Training.train_begin
        if last is not None and is_own:
            self.learner.resume(last)
            self.learner.network.set_train()

    def _load_parameters(self, last: checkpoint.Checkpoint | None) -> None:
        config = self.network_config
        found = last
        if last is not None:
            self.learner.resume(last)
        elif config.network_dir is not None:
            place = Path(config.network_dir)
            found = checkpoint.find(place, config.network_name, config.which_network)
            self.learner.load_parameters(found)
        if found is not None and found.notice and self._is_main:
            self.session.note(found.notice)

    # Describing -----------------------------------------------------------------------------

    def _plan(self) -> Iterable[str]:
        if self.data.dataset.modes:
            yield describe_samples(self.data.dataset.directory)
        if self.data.online is not None:
            yield from self.data.online.announce()
        yield from self.data.stored.describe_parts()
        if self._unrolling is not None:
            yield self._unrolling.describe()
        size = self.batch_size * self.group.size
        if self.data.generated is None and size > self.data.stored.num_samples:
            yield f"batches of {self.data.stored.num_samples:,} samples, because there are no more"
        if self.group.size > 1:
            total, each, count = self.batch_size * self.group.size, self.batch_size, self.group.size
            yield f"batches of {total} samples, {each} in each of {count} processes"
        yield from self._told

    def _results(self, error: BaseException | None) -> Iterable[str]:
        yield f"{self.epoch_id} of {self.epoch_nb} epochs in {self._duration:.2f} s"
        if self.epoch_id > self._resumed.epoch:
            yield f"training loss {self.training_loss:.6g}"
        elif self.epoch_id >= self.epoch_nb:
            yield "nothing left to train: epoch_nb (--epoch-nb) is the total number of epochs"
        if not math.isinf(self.best.loss):
            yield self.best.describe(self._decisive)
        if self.environment_config is not None:
            yield describe_samples(self.data.dataset.directory)
        if self.data.online is not None:
            yield from self.data.online.describe()
        if self.checkpoint_path is not None:
            yield f"checkpoint: {self.checkpoint_path}"

    def _findings(self) -> dict[str, Any]:
        judged, places = self._judgment, {"statistics": str(self.session.stats_dir)}
        numbers = {
            "loss/training": self.training_loss,
            "loss/validation": self.validation_loss,
            f"{self.monitor or 'loss'}/best": as_loss(self.monitor or "", self.best.loss),
            "predicted samples per s": judged.rate,
        }
        if self.checkpoint_path is not None:
            places["checkpoint"] = str(self.checkpoint_path)
        for name, dataset in self.data.stored.datasets.items():
            places[f"dataset {name}".strip()] = str(dataset.directory)
        return {
            "numbers": {name: value for name, value in numbers.items() if math.isfinite(value)},
            "parts": judged.parts,
            "why": judged.why,
            "places": places,
        }

    def _next(self, error: BaseException | None) -> Iterable[str]:
        path = shlex.quote(str(self.session.path))
        if self.checkpoint_path is None:
            return
        if error is None:
            plain, kinds = to_plain(self.network_config), ("network", "transformation")
            named = {kind: plain.get(kind, "") for kind in kinds}
            words = [f"--network.{k} {shlex.quote(v)}" for k, v in named.items() if ":" in v]
            yield " ".join(["physx predict", path, "ENVIRONMENT --step-nb N", *words])
            yield f"physx stats {path}"
            if changes := self._changes_to_learn():
                options = (f"--dataset.normalize.{shlex.quote(each)} increment" for each in changes)
                yield " ".join([f"physx train --config {path}", *options])
        elif self._is_resumable:
            yield f"physx train {path} --resume"
        else:
            yield f"physx train --config {path} --network.network-dir {path}"

    def _changes_to_learn(self) -> list[str]:
        """Return targets that "nothing changes" predicts better, and that are not increments."""
        known = self.learner.transformation.normalization
        learned = {name for name, each in known.items() if each.since}
        fields = {n: of for part in self._judgment.parts.values() for n, of in part.fields.items()}
        return [
            name
            for name, of in fields.items() if name not in learned
            if UNCHANGED in of.rivals and of.rivals[UNCHANGED].verdict == "loses"
        ]  # fmt: skip

    def _components(self) -> Mapping[str, str]:
        return describe_training(self.learner, self.environment_config, self.data.dataset)

    def _predict(self, batch: Batch) -> Batch:
        """Answer `Environment.get_prediction`; before the first batch, use the step's shapes."""
        learner, data = self.learner, getattr(self, "data", None)
        if not learner.fields and data is not None:
            known = [name for name, field in data.fields.items() if field.shape is not None]
            if all(name in known for name in learner.batch_fields):
                learner.bind(data.fields, data.normalization())
        return learner.predict_in_training(batch)
