"""Study: the folder of a sweep, with a session for each trial and a table of their results."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import tomli_w

from physx_cluster.errors import StudyError
from physx_cluster.sweep.definition import Definition
from physx_cluster.sweep.optuna import check_optuna
from physx_cluster.sweep.plan import Plan
from physx_cluster.sweep.results import COMPLETE, LOCK, TRIAL, Result, Trial
from physx_core import Closeable, files
from physx_core.config import read_toml
from physx_core.errors import PhysxError
from physx_core.results import SettingResult, SweepResult

STUDY, TABLE = "study.toml", "trials.csv"
_LOCK = "study.lock"


@dataclass(frozen=True)
class Best:
    """The setting with the best result, averaged over its seeds.

    Attributes:
        trials: The setting's trials.
        value: The mean.
    """

    trials: tuple[Trial, ...]
    value: float


class Study(Closeable):
    """The folder of a study: ``study.toml``, ``trials.csv``, and a session for each trial.

    The table has one row for each trial with a result, ordered by number. It depends only on the
    definition, not on the number of processes, on what was killed, or on timing.

    Attributes:
        folder: The folder.
        definition: The definition of the study.
        trials: The trials chosen so far, by number.
        results: The results so far, by trial number.
    """

    def __init__(self, folder: Path, definition: Definition) -> None:
        """Read the trials and results in a folder, which need not exist.

        Raises:
            StudyError: If a file is damaged.
        """
        self.folder, self.definition = folder, definition
        self.trials: dict[int, Trial] = {}
        self.results: dict[int, Result] = {}
        self._lock: files.FileLock | None = None
        for path in sorted(folder.glob(f"trial_*/{TRIAL}")):
            trial, _ = read_trial(path.parent)
            self.trials[trial.number] = trial
            result = Result.read(path.parent)
            if result is not None:
                self.results[trial.number] = result

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read a study's folder, even while its sweep is running.

        Raises:
            StudyError: If there is no study, or one of its files is damaged.
        """
        if not (folder / STUDY).is_file():
            raise StudyError(
                f"There is no study in {folder}: {STUDY} is missing. Create one: physx sweep FILE"
            )
        return cls(folder, Definition.read(folder / STUDY, folder.resolve().name, builds=False))

    @classmethod
    def open(cls, folder: Path, definition: Definition) -> Self:
        """Create a study, or resume the one in the folder; no other process can write to it.

        Raises:
            StudyError: If another sweep is writing to it, or its definition differs in a way that
                changes results.
            ConfigError: If the sampler or the pruner cannot be used.
        """
        options = definition.study
        check_optuna(options.sampler, options.sampler_kwargs, options.pruner, options.pruner_kwargs)
        Plan(definition)
        try:
            files.make_folder(folder)
            lock = files.try_lock(folder / _LOCK)
        except OSError as error:
            raise StudyError(f"Cannot write to the study {folder}: {error.strerror}.") from None
        if lock is None:
            raise StudyError(f"Another sweep is writing to {folder}: wait for it, or stop it.")
        try:
            former = folder / STUDY
            if former.exists():
                change = definition.find_change(read_toml(former))
                if change:
                    raise StudyError(
                        f"{folder} holds a study with another definition: {change}. Use the same "
                        "one, or another folder (--study). Only study.trials may grow, and [run] "
                        "may change."
                    )
            files.replace(former, tomli_w.dumps(definition.plain).encode())
            study = cls(folder, definition)
        except BaseException:
            lock.close()
            raise
        study._lock = lock
        study.write_table()
        return study

    def close(self) -> None:
        """Allow other processes to write to it."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def folder_of(self, trial: Trial) -> Path:
        """Return the folder of a trial's session."""
        return self.folder / trial.name

    def prepare(self, trial: Trial) -> None:
        """Create the folder of a trial's session, with its setting and tables.

        Raises:
            StudyError: If the folder contains another trial.
        """
        folder = self.folder_of(trial)
        former = self.trials.get(trial.number)
        if former is not None and former != trial:
            raise StudyError(
                f"{folder} does not contain the trial that is next: it has {former.values}, not "
                f"{trial.values}. Its results were changed, or Optuna's version is different: "
                "use the former version, or start another study (--study)."
            )
        files.make_folder(folder)
        tables = self.definition.pipelines[trial.pipeline].with_setting(trial.values, trial.seed)
        content = tomli_w.dumps({"trial": vars(trial), "pipelines": tables}).encode()
        if former is None or (folder / TRIAL).read_bytes() != content:
            files.replace(folder / TRIAL, content)
        self.trials[trial.number] = trial

    def take_result(self, trial: Trial) -> Result | None:
        """Return the result of a trial and add it to the table; None if there is none yet."""
        if trial.number not in self.results:
            result = Result.read(self.folder_of(trial))
            if result is None:
                return None
            self.results[trial.number] = result
            self.write_table()
        return self.results[trial.number]

    def write_table(self) -> None:
        """Write ``trials.csv`` atomically.

        Raises:
            StudyError: If it cannot be written.
        """
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        columns = self.definition.columns
        head = ("trial", "pipeline", "setting", "seed", *columns)
        writer.writerow((*head, "state", "epochs", self.definition.study.result, "error"))
        for number, result in sorted(self.results.items()):
            trial = self.trials[number]
            values = [_text(trial.values.get(name)) for name in columns]
            value = "" if math.isnan(result.value) else repr(result.value)
            epochs = "" if result.epochs is None else result.epochs
            place = (number, trial.pipeline, trial.setting, trial.seed)
            writer.writerow((*place, *values, result.state, epochs, value, result.error))
        try:
            files.replace(self.folder / TABLE, text.getvalue().encode())
        except OSError as error:
            raise StudyError(
                f"Cannot write {self.folder / TABLE}: {error.strerror}. The results are kept in "
                "the trials' folders; the same command resumes the sweep."
            ) from None

    def result(self) -> SweepResult:
        """Return what the trials have found so far, by setting, in the order of the trials."""
        settings: dict[tuple[str, int], SettingResult] = {}
        for number, trial in sorted(self.trials.items()):
            key, result = (trial.pipeline, trial.setting), self.results.get(number)
            known = settings.get(key) or SettingResult(trial.pipeline, dict(trial.values))
            values, others, seed = dict(known.values), dict(known.others), str(trial.seed)
            if result is not None and result.state == COMPLETE and not math.isnan(result.value):
                values[seed] = result.value
            else:
                others[seed] = _why_without(result)
            folders = [*known.folders, trial.name]
            settings[key] = replace(known, values=values, others=others, folders=folders)
        for key, each in settings.items():
            left = {str(seed) for seed in self.definition.study.seeds}
            left -= {*each.values, *each.others}
            others = {**each.others, **dict.fromkeys(sorted(left), _why_without(None))}
            settings[key] = replace(each, others=others)
        goal: Any = "minimize" if self.definition.sign > 0 else "maximize"
        return SweepResult(self.definition.study.result, goal, list(settings.values()))

    def best(self) -> Best | None:
        """Return the setting with the best result; None if none is complete for all seeds."""
        best = self.result().best
        if best is None:
            return None
        trials = (trial for _, trial in sorted(self.trials.items()))
        return Best(tuple(each for each in trials if each.name in best.folders), best.value)

    def is_running(self, trial: Trial) -> bool:
        """Return whether a process is working on a trial."""
        path = self.folder_of(trial) / LOCK
        if not path.exists():
            return False
        lock = files.try_lock(path)
        if lock is not None:
            lock.close()
        return lock is None


def read_trial(folder: Path) -> tuple[Trial, Mapping[str, Mapping[str, Any]]]:
    """Return the trial of a folder and the tables of its pipelines.

    Raises:
        StudyError: If the folder contains no trial, or its file is damaged.
    """
    try:
        plain = read_toml(folder / TRIAL)
        trial = Trial(**plain["trial"])
        if trial.name != folder.name:
            raise ValueError(f"it belongs to {trial.name}")
        return trial, dict(plain["pipelines"])
    except (PhysxError, LookupError, TypeError, ValueError) as error:
        raise StudyError(f"{folder / TRIAL} is damaged: {error}.") from None


def earlier_results(folder: Path, trial: Trial) -> Iterator[Result | None]:
    """Yield the results of earlier trials of the same pipeline, in order.

    Trials of the trial's own batch, which may or may not have results yet, yield None.

    Args:
        folder: The study's folder.
        trial: The trial.
    """
    for path in sorted(folder.glob(f"trial_*/{TRIAL}")):
        other, _ = read_trial(path.parent)
        if other.number < trial.number and other.pipeline == trial.pipeline:
            yield Result.read(path.parent) if other.number <= trial.known else None


def is_study(folder: Path) -> bool:
    """Return whether a folder contains a study."""
    return (folder / STUDY).is_file()


def _why_without(result: Result | None) -> str:
    """Return why a trial has no number to compare."""
    if result is None:
        return "not finished"
    return result.error or (result.state if result.state != COMPLETE else "not a number")


def _text(value: Any) -> str:
    """Format a parameter's value for the table; empty if the pipeline does not have it."""
    if value is None:
        return ""
    return value if isinstance(value, str) else json.dumps(value)
