"""SlurmExecutor: each trial is a Slurm job, submitted by submitit."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from physx_cluster.launchers.slurm_guard import Guard
from physx_cluster.launchers.slurm_queue import (
    UNKNOWN_TO_SCHEDULER,
    JobState,
    SlurmQueue,
    find_controller,
)
from physx_cluster.sweep.executors.executor import (
    PATIENCE,
    Executor,
    Job,
    command_of,
    describe_status,
    start_process,
    variables_of,
)
from physx_cluster.sweep.results import OUTPUT
from physx_core import files
from physx_core.errors import ConfigError, MissingLibraryError
from physx_core.processes import ChildProcess

_FOLDER = "jobs"
_TIMEOUTS = 1_000  # how often submitit requeues a job that times out
_RARELY = 5.0  # s between queries of the queue


class SlurmExecutor(Executor):
    """Runs each trial as a Slurm job, or as a process of submitit's local executor.

    All nodes need the study's folder and the sweep's working directory under the same path, as on a
    shared disk. A job that is preempted or reaches its time limit is requeued and resumes the
    trial. All jobs end with the sweep, even if it is killed.
    """

    interval = 0.5

    def __init__(self, options: Mapping[str, Any], threads: int) -> None:
        """Find Slurm.

        Args:
            options: submitit's parameters, for example ``timeout_min`` or ``slurm_partition``, and
                ``cluster``: "slurm", or "local" for processes on this machine.
            threads: Threads of each trial; also the default of ``cpus_per_task``.

        Raises:
            MissingLibraryError: If submitit is not installed.
            ConfigError: If `cluster` is invalid, or Slurm is not available here.
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
        if self._cluster not in ("slurm", "local"):
            raise ConfigError(
                f'run.options.cluster is {self._cluster!r}, but must be "slurm" or "local".'
            )
        if self._cluster == "slurm":
            find_controller()
        logging.getLogger("submitit").setLevel(logging.WARNING)
        self._variables = variables_of(threads)
        self._queue: SlurmQueue | None = None
        self._states: dict[str, JobState] = {}
        self._asked = 0.0
        self._executor: Any = None
        self._guard: Guard | None = None
        self._jobs: list[SlurmJob] = []

    def start(self, folder: Path) -> SlurmJob:
        """Submit the job of a trial; see `Executor.start`."""
        if self._executor is None:
            self._open(folder.parent / _FOLDER)
        run = TrialJob(command_of(folder), self._variables, str(folder / OUTPUT))
        try:
            submitted = self._executor.submit(run)
        except self._submitit.core.utils.FailedJobError as error:
            reason = " ".join(str(error).split()[-60:])
            raise ConfigError(f"Slurm rejects the job of a trial: {reason}") from None
        self._asked = 0.0
        job = SlurmJob(submitted, self)
        self._jobs = [each for each in self._jobs if not each.is_over]
        self._jobs.append(job)
        return job

    def state_of(self, job: Any) -> JobState:
        """Return the state of a job in the queue; all jobs are queried together, at intervals."""
        if self._queue is None:
            return JobState("FINISHED" if job.done() else "RUNNING")
        if time.monotonic() - self._asked > _RARELY:
            found = self._queue.states()
            self._asked = time.monotonic()
            self._states = self._states if found is None else found
        return self._states.get(job.job_id, UNKNOWN_TO_SCHEDULER)

    def cancel(self, job: Any) -> None:
        """End a job."""
        if self._queue is None:
            job.cancel(check=False)
        else:
            self._queue.cancel([job])

    def close(self) -> None:
        """End all jobs."""
        for job in self._jobs:
            job.close()
        guard, self._guard = self._guard, None
        if guard is not None:
            guard.close()

    def _open(self, folder: Path) -> None:
        """End an earlier sweep's remaining jobs, and make new ones end with this process."""
        name = f"physx-{hashlib.sha256(str(folder).encode()).hexdigest()[:12]}"
        if self._cluster == "slurm":
            self._queue = SlurmQueue(name)
            left = self._queue.states() or {}
            self._queue.cancel(SimpleNamespace(job_id=each) for each in left)
        files.make_folder(folder)
        try:
            self._executor = self._submitit.AutoExecutor(
                folder, self._cluster, slurm_max_num_timeout=_TIMEOUTS
            )
            self._executor.update_parameters(name=name, **self._options)
        except (NameError, TypeError, ValueError, AssertionError) as error:
            raise ConfigError(f"submitit rejects the options of the executor: {error}") from None
        self._guard = Guard(folder, name if self._queue is not None else "")


class SlurmJob(Job):
    """The job of a trial.

    Attributes:
        is_over: Whether it is known to have ended.
    """

    def __init__(self, job: Any, executor: SlurmExecutor) -> None:
        self._job, self._executor, self.is_over = job, executor, False

    def has_ended(self) -> bool:
        """Return whether it has ended.

        Raises:
            ConfigError: If Slurm will never start it.
        """
        if not self.is_over:
            state = self._executor.state_of(self._job)
            if state.is_unschedulable:
                raise ConfigError(
                    f"Slurm cannot give job {self._job.job_id} what it requests ({state.reason}). "
                    "Set a job's resources with run.options, such as timeout_min, mem_gb and "
                    'slurm_partition; "sinfo" shows what is available.'
                )
            self.is_over = state.is_over or self._job.paths.result_pickle.exists()
        return self.is_over

    def describe_end(self) -> str:
        """Describe its exit status, or what Slurm reports."""
        with contextlib.suppress(Exception):  # submitit may raise anything
            return describe_status(self._job.result())
        return f"ended together with its job {self._job.job_id}"

    def close(self) -> None:
        """End the job."""
        if not self.is_over:
            self._executor.cancel(self._job)


class TrialJob:
    """The work of a job: runs a trial, and is requeued when its time is up."""

    def __init__(self, command: Sequence[str], variables: Mapping[str, str], output: str) -> None:
        """Store the command.

        Args:
            command: Words of the command.
            variables: Environment variables in addition to the job's.
            output: File to append the output to.
        """
        self._command, self._variables, self._output = command, variables, output

    def __call__(self) -> int | None:
        """Run the command and return its exit status."""
        process = start_process(self._command, self._variables, self._output)
        _RUNNING.append(process)
        try:
            return process.wait()
        finally:
            process.close(PATIENCE)

    def checkpoint(self) -> Any:
        """Have the trial write a checkpoint; return the work of the requeued job."""
        import submitit

        for process in _RUNNING:
            process.close(PATIENCE)
        return submitit.helpers.DelayedSubmission(self)


_RUNNING: list[ChildProcess] = []
"""The process of this job, which submitit's signal handler must end."""
