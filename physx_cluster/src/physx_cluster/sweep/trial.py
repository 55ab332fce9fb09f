"""The process of a trial: ``python -m physx_cluster.sweep.trial FOLDER``.

It resumes where an earlier process ended, however that ended, and reaches the same result. The
numbers to compare are read from ``stats/scalars.csv``, so they do not depend on who computed them.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import sys
import time
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from physx_cluster.errors import StudyError
from physx_cluster.sweep.definition import StudyOptions, build_stage
from physx_cluster.sweep.optuna import Pruning
from physx_cluster.sweep.results import (
    COMPLETE,
    FAILURE,
    LOCK,
    OUTPUT,
    PRUNED,
    RESULT,
    TRIAL,
    Failure,
    Result,
    Trial,
)
from physx_cluster.sweep.study import STUDY, earlier_results, read_trial
from physx_core import DataGeneration, Training, files, read_scalars
from physx_core.config import from_plain, read_toml
from physx_core.errors import (
    CheckpointError,
    ComponentNotFoundError,
    ConfigError,
    DatasetError,
    DatasetNotFoundError,
    DivergedError,
    FieldsMismatchError,
    MissingLibraryError,
    PluginError,
    PluginNotFoundError,
    ReferenceFormError,
    SessionError,
    UsageError,
    listed,
    nearest,
)
from physx_core.processes import raised_at_sigterm

GENERATED = "generated"
"""File that marks the trial's data generation as complete."""
P = TypeVar("P", bound=DataGeneration | Training)
Tables = Mapping[str, Mapping[str, Any]]

_KEPT = (TRIAL, LOCK, OUTPUT)
_OF_STUDY = (
    StudyError, MissingLibraryError, PluginError, PluginNotFoundError, ComponentNotFoundError,
    ReferenceFormError, DatasetNotFoundError,
)  # fmt: skip
"""Errors that would end every trial: they are not results, and do not go away by themselves."""
_OF_DISK = (DatasetError, SessionError, CheckpointError)
"""Errors that are not results either, but may go away."""
_FINAL = (ConfigError, UsageError, DivergedError, FieldsMismatchError)
"""Errors that do not go away by themselves."""
_OF_SYSTEM = (
    errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.ENOMEM, errno.EMFILE,
    errno.ENFILE, errno.ESTALE, errno.EACCES, errno.EPERM,
)  # fmt: skip
"""Error numbers of a failing machine or disk."""
_EVERY_EPOCH = "loss/training"
_PATIENCE = 0.2
"""Time in s between checks whether another process is still working on the trial."""


class _CannotResumeError(Exception):
    """A training cannot be resumed and starts over."""


class TrialTraining(Training):
    """A training that a pruner may end after each epoch.

    Attributes:
        options: What the study compares.
        pruning: Decides after each epoch; None: the training runs to its end.
        is_pruned: Whether the pruner has ended it.
    """

    options: StudyOptions
    pruning: Pruning | None = None
    is_pruned = False

    def train_begin(self) -> None:
        """Check that the numbers of all earlier epochs exist; a power cut may have lost some."""
        if self.epoch_id:
            known = read_scalars(self.session.path).get(("epoch", _EVERY_EPOCH), {})
            if not all(epoch in known for epoch in range(1, self.epoch_id + 1)):
                raise _CannotResumeError("numbers of earlier epochs are lost")

    def epoch_condition(self) -> bool:
        """Return whether epochs are left and neither patience nor the pruner has ended it."""
        if self.pruning is not None and self.epoch_id and not self.is_pruned:
            self.is_pruned = self.pruning.decide(self.numbers())
        return super().epoch_condition() and not self.is_pruned

    def numbers(self) -> dict[int, float]:
        """Return the numbers to compare, by epoch.

        Raises:
            StudyError: If the training does not record them.
        """
        series = read_scalars(self.session.path)
        found = series.get(("epoch", self.options.result))
        if found is None:
            names = [name for timeline, name in series if timeline == "epoch"]
            raise StudyError(
                f'The trainings do not record "{self.options.result}", the number to compare '
                f"(study.result).{nearest(self.options.result, names)} Each epoch, they record: "
                f"{listed(names)}."
            )
        return {epoch: found[epoch] for epoch in sorted(found) if epoch <= self.epoch_id}

    @property
    def _decided(self) -> str:
        """What the validation samples decide: the trials are compared by them."""
        return " and ".join(filter(None, [super()._decided, "which trial is the best"]))

    def outcome(self) -> Result:
        """Return the trial's result."""
        numbers = self.numbers()
        state = PRUNED if self.is_pruned else COMPLETE
        rungs = self.pruning.rungs if self.pruning is not None else {}
        finite = [value for value in numbers.values() if math.isfinite(value)]
        value = next(reversed(numbers.values()), math.nan)
        if self.options.epoch == "best" and finite:
            value = min(finite) if self.options.goal == "minimize" else max(finite)
        return Result(state, value, self.epoch_id, "", numbers, rungs)


def run_trial(folder: Path) -> None:
    """Run or resume a trial; its folder then contains its result or its error.

    Args:
        folder: The trial's session.

    Raises:
        SystemExit: After SIGTERM, with status 143, once a checkpoint is written.
    """
    lock = files.try_lock(folder / LOCK)
    while lock is None:  # a process of a killed sweep is about to end
        time.sleep(_PATIENCE)
        lock = files.try_lock(folder / LOCK)
    with lock:
        if not (folder / RESULT).exists():
            files.remove(folder / FAILURE)
            _attempt(folder)


def _attempt(folder: Path) -> None:
    try:
        trial, tables = read_trial(folder)
        options = from_plain(StudyOptions, read_toml(folder.parent / STUDY).get("study", {}))
        _generate(folder, tables)
        _train(folder, trial, tables, options).write(folder)
    except Exception as error:
        traceback.print_exc()
        describe(error).write(folder)
        sys.exit(1)


def _generate(folder: Path, tables: Tables) -> None:
    """Generate the data of a trial that has its own; an interrupted generation starts over."""
    if "data_generation" in tables and not (folder / GENERATED).exists():
        _start_over(folder)
        _build("data_generation", tables, DataGeneration, folder).execute()
        files.replace(folder / GENERATED, b"")


def _train(folder: Path, trial: Trial, tables: Tables, options: StudyOptions) -> Result:
    generates = "environment" in tables["training"]
    begun = any((folder / "network").glob("*/checkpoint.toml"))
    if begun or (generates and (folder / "dataset").exists() and "data_generation" not in tables):
        try:
            return _run_training(folder, trial, tables, options, resume=True)
        except _CannotResumeError as error:
            sys.stderr.write(f"The training starts over: {error}\n")
    if generates or "data_generation" not in tables:
        _start_over(folder)
        _generate(folder, tables)
    else:  # keep the data
        files.remove_folder(folder / "network")
        files.remove_folder(folder / "stats")
    return _run_training(folder, trial, tables, options, resume=False)


def _run_training(
    folder: Path, trial: Trial, tables: Tables, options: StudyOptions, *, resume: bool
) -> Result:
    training = _build("training", tables, TrialTraining, folder, resume=resume)
    training.options = options
    if options.pruner is not None:
        earlier = earlier_results(folder.parent, trial)
        training.pruning = Pruning(options.pruner, options.pruner_kwargs, options.goal, earlier)
    try:
        training.__enter__()
    except (ConfigError, CheckpointError, DatasetError) as error:
        if resume:
            raise _CannotResumeError(str(error)) from error
        raise
    with contextlib.ExitStack() as opened:
        opened.push(training)
        training.execute()
        return training.outcome()


def _build(kind: str, tables: Tables, make: type[P], folder: Path, **given: Any) -> P:
    """Return a pipeline in the trial's session, which saves a checkpoint after each epoch."""
    table = {**tables[kind], "session_dir": str(folder.parent), "session_name": folder.name}
    writes = table.get("network", {}).get("save_each_epoch", False)
    if kind == "training" and not writes and not table.get("checkpoint_every"):
        table["checkpoint_every"] = "epoch"
    return build_stage(kind, {**table, "new_session": False, **given}, make)


def _start_over(folder: Path) -> None:
    """Remove everything that earlier processes left of a trial."""
    for path in folder.iterdir():
        if path.name not in _KEPT:
            (files.remove_folder if path.is_dir() else files.remove)(path)


def describe(error: Exception) -> Failure:
    """Classify an error that ended an attempt at a trial."""
    system = any(map(_is_of_system, _chain(error)))
    is_ours = isinstance(error, _OF_DISK) and not isinstance(error, FieldsMismatchError)
    is_result = not system and not is_ours and not isinstance(error, _OF_STUDY)
    is_final = not system and isinstance(error, (*_FINAL, *_OF_STUDY))
    return Failure(type(error).__name__, str(error), is_final, is_result)


def _chain(error: BaseException) -> Iterator[BaseException]:
    """Yield an error and its causes."""
    following: BaseException | None = error
    while following is not None:
        yield following
        hidden = following.__suppress_context__
        following = following.__cause__ or (None if hidden else following.__context__)


def _is_of_system(error: BaseException) -> bool:
    return isinstance(error, MemoryError) or (
        isinstance(error, OSError) and error.errno in _OF_SYSTEM
    )


def main() -> None:
    """Run the trial named on the command line, in the sweep's working directory."""
    folder, place = map(Path, sys.argv[1:])
    os.chdir(place)
    with raised_at_sigterm():
        run_trial(folder)


if __name__ == "__main__":
    main()
