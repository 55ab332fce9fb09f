"""Runs the trials of a study, batch by batch, until each has a result."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from physx_cluster.errors import StudyError
from physx_cluster.sweep.definition import Definition
from physx_cluster.sweep.executors.executor import Executor, Job
from physx_cluster.sweep.plan import Plan
from physx_cluster.sweep.results import FAILED, FAILURE, OUTPUT, Failure, Result, Trial
from physx_cluster.sweep.study import TABLE, Study
from physx_core import Closeable, files, plugins, results
from physx_core.errors import PhysxError

Say = Callable[[str], None]
Start = Callable[[Definition], Executor]


def run_study(definition: Definition, folder: Path, say: Say, start: Start | None = None) -> Study:
    """Run all trials of a study that have no result yet; return the closed study.

    Args:
        definition: The definition of the study.
        folder: Folder of the study; an existing study is resumed.
        say: Prints a line for the user.
        start: Starts the executor; None: the one named in the definition.

    Raises:
        StudyError: If the folder contains another study, or trials were given up; the same call
            resumes it.
        ConfigError: If the sampler, pruner or executor cannot be used as specified.
    """
    with Study.open(folder, definition) as study:
        plan = Plan(definition)
        say(f"study: {folder} ({plan.total} trials, {len(study.results)} of them done)")
        if plan.together < min(definition.run.parallel, plan.total):
            say(
                f"note: only {plan.together} of {definition.run.parallel} (run.parallel) trials "
                "can run at the same time, those of a batch "
                f"(study.batch = {definition.study.batch})"
            )
        begin = time.monotonic()
        try:
            with _Workers(study, start or _start_executor, say, plan.total) as workers:
                while batch := plan.next_batch():
                    for trial in batch:
                        study.prepare(trial)
                    workers.run(batch)
                    plan.tell(study.results)
        finally:
            _store(study, plan.total, time.monotonic() - begin)
    return study


def _store(study: Study, total: int, seconds: float) -> None:
    """Keep in the study's folder what the trials have found so far."""
    summary = [f"{len(study.results)} of {total} trials have a result"]
    places = {"table": str(study.folder / TABLE)}
    found = study.result()
    result = results.Result(
        "sweep", str(study.folder), seconds, summary, sweep=found, places=places
    )
    results.store_result(study.folder, result)


def _start_executor(definition: Definition) -> Executor:
    kind, run = "trial_executor", definition.run
    make = plugins.resolve(kind, plugins.complete_reference(kind, run.executor))
    executor: Executor = make(run.options, definition.study.threads)
    return executor


@dataclass
class _Attempts:
    """The attempts at a trial.

    Attributes:
        trial: The trial.
        in_vain: Number of consecutive attempts without progress.
        reached: Progress of the last attempt.
    """

    trial: Trial
    in_vain: int = 0
    reached: frozenset[str] = field(default_factory=frozenset)


class _Workers(Closeable):
    """Runs trials concurrently, and restarts those that end without a result."""

    def __init__(self, study: Study, start: Start, say: Say, total: int) -> None:
        self._study, self._say, self._total = study, say, total
        self._run = study.definition.run
        self._start = start
        self._executor: Executor | None = None
        self._jobs: dict[Job, _Attempts] = {}
        self._given_up: list[tuple[Trial, str]] = []
        self._is_in_vain = False  # whether every trial would end with the same error

    def close(self) -> None:
        """End the trials that are still running."""
        if self._executor is not None:
            self._executor.close()

    def run(self, batch: Sequence[Trial]) -> None:
        """Run the trials of a batch until each has a result.

        Raises:
            StudyError: If trials were given up.
        """
        waiting = [_Attempts(trial) for trial in batch if self._study.take_result(trial) is None]
        while waiting or self._jobs:
            while waiting and len(self._jobs) < self._run.parallel:
                self._begin(waiting.pop(0))
            ended = [job for job in self._jobs if job.has_ended()]
            for job in ended:
                attempts = self._jobs.pop(job)
                if self._is_unfinished(attempts, job):
                    waiting.insert(0, attempts)
            waiting = [] if self._is_in_vain else waiting
            if not ended:
                time.sleep(self._executor.interval if self._executor is not None else 0.0)
        if self._given_up:
            raise self._error()

    def _begin(self, attempts: _Attempts) -> None:
        if self._executor is None:
            self._executor = self._start(self._study.definition)
        folder = self._study.folder_of(attempts.trial)
        attempts.reached = _reached(folder)
        files.remove(folder / FAILURE)
        self._jobs[self._executor.start(folder.resolve())] = attempts

    def _is_unfinished(self, attempts: _Attempts, job: Job) -> bool:
        """Take the result of a trial whose process has ended; return whether to try again."""
        trial = attempts.trial
        folder = self._study.folder_of(trial)
        result = self._study.take_result(trial)
        if result is not None:
            self._tell(trial, result)
            return False
        failure = Failure.read(folder)
        advances = bool(_reached(folder) - attempts.reached)
        attempts.in_vain = 0 if advances else attempts.in_vain + 1
        why = f"{failure.error}: {failure.message}" if failure is not None else job.describe_end()
        is_final = failure is not None and failure.is_final
        if not is_final and attempts.in_vain <= self._run.restarts:
            self._say(f"{self._name(trial)} {_short(why)}; resuming it")
            return True
        if failure is not None and failure.is_result:
            Result(FAILED, error=failure.error).write(folder)
            result = self._study.take_result(trial)
            assert result is not None
            self._tell(trial, result, failure.message)
        else:
            self._given_up.append((trial, why))
            self._is_in_vain |= is_final
            self._say(f"{self._name(trial)} {_short(why)}; giving it up")
        return False

    def _tell(self, trial: Trial, result: Result, message: str = "") -> None:
        text = f"{self._study.definition.study.result} {result.value:.6g}"
        if result.state == FAILED:
            text = f"{result.error}: {_short(message)}" if message else result.error
        self._say(f"{self._name(trial)}: {result.state}, {text}")

    def _name(self, trial: Trial) -> str:
        return f"trial {trial.number} of {self._total} ({describe_trial(trial)})"

    def _error(self) -> PhysxError:
        trial, why = self._given_up[0]
        count = len(self._given_up)
        others = f" ({count} trials were given up in total.)" if count > 1 else ""
        output = self._study.folder_of(trial) / OUTPUT
        return StudyError(
            f"Trial {trial.number} ({describe_trial(trial)}) has no result: "
            f"{_sentence(why)}{others} See {output}. Once this is fixed, the same command "
            "resumes the sweep."
        )


def describe_trial(trial: Trial) -> str:
    """Describe a trial by its pipeline, setting and seed."""
    values: Mapping[str, object] = trial.values
    settings = [f"{name.rpartition('.')[2]} {_number(value)}" for name, value in values.items()]
    return ", ".join([trial.pipeline, *settings, f"seed {trial.seed}"])


def _number(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _reached(folder: Path) -> frozenset[str]:
    """Return what a trial has produced so far; later attempts continue from there."""
    names = {path.parent.name for path in folder.glob("network/*/checkpoint.toml")}
    return frozenset(names | {path.name for path in folder.glob("generated")})


def _short(text: str) -> str:
    line = text.strip().partition("\n")[0]
    return line if len(line) <= 160 else f"{line[:157]}..."


def _sentence(why: str) -> str:
    text = why.strip()
    return text if text.endswith(".") else f"{text}."
