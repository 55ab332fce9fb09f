"""SlurmExecutor: each trial is a job of Slurm, submitted by submitit."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from physx_cluster.sweep.executors.executor import (
    PATIENCE,
    Executor,
    Job,
    command_of,
    describe_status,
    variables_of,
)
from physx_cluster.sweep.results import OUTPUT
from physx_core.errors import ConfigError, MissingLibraryError, StudyError
from physx_core.processes import ChildProcess

_FOLDER = "jobs"
_OWN = ("cluster",)


class SlurmExecutor(Executor):
    """Runs each trial as a job of Slurm, or by another executor of submitit.

    All nodes need the study's folder and the sweep's working directory under the same path, as a
    shared disk provides them. A job that is preempted or reaches its time limit is requeued, and
    continues the trial.
    """

    interval = 1.0

    def __init__(self, options: Mapping[str, Any], threads: int) -> None:
        """Find Slurm.

        Args:
            options: Parameters of submitit's jobs, for example ``timeout_min`` or
                ``slurm_partition``, and ``cluster``: "slurm", or "local" for jobs on this machine.
            threads: Threads of each trial; also what ``cpus_per_task`` is by default.

        Raises:
            MissingLibraryError: If submitit is not installed.
            StudyError: If there is no Slurm here.
            ConfigError: If submitit does not know an option.
        """
        try:
            import submitit
        except ImportError:
            raise MissingLibraryError(
                'The executor "slurm"', "submitit", "slurm", "physx-cluster"
            ) from None
        self._submitit = submitit
        self._options = {"cpus_per_task": threads, **options}
        self._cluster = self._options.pop("cluster", "slurm")
        self._variables = variables_of(threads)
        self._executor: Any = None
        self._jobs: list[SlurmJob] = []

    def start(self, folder: Path) -> SlurmJob:
        """Submit the job of a trial; see `Executor.start`."""
        if self._executor is None:
            self._executor = self._make(folder.parent)
        self._executor.update_parameters(name=folder.name)
        run = TrialJob(command_of(folder), self._variables, str(folder / OUTPUT))
        job = SlurmJob(self._executor.submit(run))
        self._jobs = [each for each in self._jobs if not each.has_ended()]
        self._jobs.append(job)
        return job

    def close(self) -> None:
        """Cancel all jobs."""
        for job in self._jobs:
            job.close()

    def _make(self, study: Path) -> Any:
        try:
            executor = self._submitit.AutoExecutor(study / _FOLDER, cluster=self._cluster)
        except (RuntimeError, ValueError) as error:
            raise StudyError(
                f"There is no Slurm here ({error}): log in to a machine that has sbatch, or choose "
                'another executor (--executor local). run.options.cluster = "local" has submitit '
                "run the jobs on this machine."
            ) from None
        try:
            executor.update_parameters(**self._options)
        except (NameError, TypeError, ValueError, AssertionError) as error:
            raise ConfigError(f"submitit refuses the options of the executor: {error}") from None
        return executor


class SlurmJob(Job):
    """The job of a trial."""

    def __init__(self, job: Any) -> None:
        self._job = job
        self._is_over = False

    def has_ended(self) -> bool:
        """Return whether it has ended; Slurm is asked for all jobs at once, now and then."""
        self._is_over = self._is_over or self._job.done()
        return self._is_over

    def describe_end(self) -> str:
        """Return its exit status in words, or what Slurm says."""
        with contextlib.suppress(Exception):  # submitit raises whatever it likes
            return describe_status(self._job.result())
        return f"ended as job {self._job.job_id} in the state {self._job.state}"

    def close(self) -> None:
        """Cancel it."""
        if not self.has_ended():
            self._job.cancel(check=False)


class TrialJob:
    """What a job does: it runs a trial, and is requeued if its time is up."""

    def __init__(self, command: Sequence[str], variables: Mapping[str, str], output: str) -> None:
        """Keep the command.

        Args:
            command: Its words.
            variables: Environment variables beside those of the job.
            output: File that its output is appended to.
        """
        self._command, self._variables, self._output = command, variables, output

    def __call__(self) -> int | None:
        """Run the command and return its exit status."""
        with Path(self._output).open("ab") as file:
            place = file.fileno()
            process = ChildProcess(
                self._command, variables=self._variables, stdout=place, stderr=place
            )
        _RUNNING.append(process)
        try:
            return process.wait()
        finally:
            process.close(PATIENCE)

    def checkpoint(self) -> Any:
        """Have the trial write a checkpoint; return what the requeued job does."""
        import submitit

        for process in _RUNNING:
            process.close(PATIENCE)
        return submitit.helpers.DelayedSubmission(self)


_RUNNING: list[ChildProcess] = []
"""The process of this job, which submitit's handler of signals must end."""
