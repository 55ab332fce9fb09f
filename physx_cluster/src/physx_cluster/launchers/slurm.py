"""SlurmLauncher: clients as Slurm jobs."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from physx_cluster.launchers.slurm_guard import Guard
from physx_cluster.launchers.slurm_queue import (
    UNKNOWN_TO_SCHEDULER,
    JobState,
    LocalQueue,
    Queue,
    SlurmQueue,
    find_controller,
)
from physx_cluster.placement.address import address_towards
from physx_core import files
from physx_core.components import ClientHandle, Launcher
from physx_core.errors import ClientError, ConfigError
from physx_core.net import TOKEN_VARIABLE
from physx_core.origin import install_hint

try:
    import submitit
except ImportError as error:
    raise ConfigError(
        f"The launcher cluster/slurm needs submitit: {error}. "
        f"{install_hint('physx-cluster', 'slurm')}"
    ) from error

from physx_cluster.launchers.slurm_job import TOKEN, ClientJob, status_file

_RARELY = 5.0  # s between queries of the queue
_SOON = 0.25  # s between queries while someone waits for the answer
_TIMEOUTS = 1_000  # how often submitit requeues a job that times out
_LEAVE_TIME = 10.0  # s, for jobs to leave the queue
_PAUSE = 0.05
_INTERRUPTED = -15
_ADVICE = (
    "Set a job's resources with launcher_kwargs, such as timeout_min, mem_gb, cpus_per_task and "
    'slurm_partition; "sinfo" shows what is available.'
)


class SlurmLauncher(Launcher):
    """Starts each client as a Slurm job; clients that start together form one job array.

    A job that is preempted or reaches its time limit is requeued; its client then resumes where it
    was (`EnvironmentConfig.retries`), with the same rows. Time in the queue does not count as
    silence of the client (`EnvironmentConfig.timeout`).
    """

    elsewhere = True

    def __init__(
        self,
        *,
        cluster: str = "slurm",
        folder: str = ".",
        queue_time: float = 3600.0,
        timeout_min: int = 60,
        **parameters: Any,
    ) -> None:
        """Store the options.

        Args:
            cluster: "slurm", or "local" to run the jobs as processes on this machine.
            folder: Folder on a disk that all nodes share. A hidden folder inside it, accessible
                only to its owner, holds the token and the jobs' output until the run ends.
            queue_time: Longest time in s that a job may be queued.
            timeout_min: Time limit of a job in min; the job is then requeued.
            parameters: Parameters of `submitit.AutoExecutor`, such as ``mem_gb=4``,
                ``cpus_per_task=2`` or ``slurm_partition="gpu"``.

        Raises:
            ConfigError: If `cluster` is invalid, or submitit does not know a parameter.
        """
        if cluster not in ("slurm", "local"):
            raise ConfigError(f'cluster is {cluster!r}, but must be "slurm" or "local".')
        self._cluster, self._place, self.queue_time = cluster, Path(folder), queue_time
        self._parameters = {"timeout_min": timeout_min, **parameters}
        self._queue: Queue | None = None
        self._folder = Path()
        self._guard: Guard | None = None
        self._handles: dict[int, JobHandle] = {}
        self._asked, self._states = 0.0, dict[str, JobState]()
        logging.getLogger("submitit").setLevel(logging.WARNING)

    def open(self) -> str | None:
        """Find Slurm and create the run's folder: see `Launcher.open`.

        Raises:
            ConfigError: If Slurm does not answer, there is no route to it, the folder cannot be
                created, or a parameter is invalid.
        """
        controller = None if self._cluster == "local" else find_controller()
        name = f"physx-{secrets.token_hex(6)}"
        try:
            self._folder = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=self._place.resolve()))
        except OSError as error:
            raise ConfigError(
                f"Cannot create the jobs' folder in {self._place}: {error}. Name a folder that "
                'all nodes share with launcher_kwargs={"folder": ...}.'
            ) from error
        local = LocalQueue(self._folder)
        self._queue = local if controller is None else SlurmQueue(name)
        self._local_jobs = local.jobs
        try:
            self._executor = self._make_executor(name)
        except Exception:
            self._folder.rmdir()
            raise
        self._guard = Guard(self._folder, "" if controller is None else name)
        return None if controller is None else address_towards(controller)

    def launch(self, instances: Sequence[int], address: str, token: str) -> list[ClientHandle]:
        """Submit the jobs, or reuse those that Slurm has requeued: see `Launcher.launch`."""
        self._write_token(token)
        former = {number: self._handles.get(number) for number in instances}
        again = {number: old for number, old in former.items() if old and old.runs_again()}
        fresh = [number for number in instances if number not in again]
        jobs = {number: old.job for number, old in again.items()}
        for number in instances:
            with contextlib.suppress(FileNotFoundError):
                files.remove(status_file(self._folder, number))
        jobs |= self._submit(fresh, address) if fresh else {}
        self._local_jobs.update(jobs)
        for number in instances:
            old = again.get(number)
            runs = old.look(_SOON).runs if old else 0
            self._handles[number] = JobHandle(number, jobs[number], self, self._folder, runs)
        return [self._handles[number] for number in instances]

    def close(self) -> None:
        """Wait for the jobs to leave the queue, and remove the folder: see `Launcher.close`."""
        until = time.monotonic() + _LEAVE_TIME
        while self._jobs_left() and time.monotonic() < until:
            time.sleep(_SOON)
        guard, self._guard = self._guard, None
        if guard is not None:
            guard.close()

    def state_of(self, job: Any, max_age: float) -> JobState:
        """Return the state of a job in the queue; all jobs are queried at once.

        Args:
            job: The job.
            max_age: Maximum age of the answer in s.
        """
        assert self._queue is not None
        if time.monotonic() - self._asked > max_age:
            found = self._queue.states()
            self._asked = time.monotonic()
            if found is not None:
                self._states = found
        return self._states.get(job.job_id, UNKNOWN_TO_SCHEDULER)

    def interrupt(self, job: Any) -> None:
        """Ask a job's client to exit."""
        assert self._queue is not None
        self._queue.interrupt(job)

    def cancel(self, job: Any) -> None:
        """End a job immediately."""
        assert self._queue is not None
        self._queue.cancel([job])
        self._asked = 0.0

    def _submit(self, instances: Sequence[int], address: str) -> dict[int, Any]:
        work = [ClientJob(self._folder, number, address) for number in instances]
        self._executor.update_parameters(slurm_array_parallelism=len(work))
        self._asked = 0.0
        try:
            with _without_token(), self._executor.batch():
                jobs = [self._executor.submit(job) for job in work]
        except (submitit.core.utils.FailedJobError, submitit.core.utils.FailedSubmissionError) as e:
            reason = " ".join(str(e).split()[-60:])
            raise ClientError(
                instances[0],
                f"was refused by Slurm: {reason}. {_ADVICE}",
            ) from e
        return dict(zip(instances, jobs, strict=True))

    def _make_executor(self, name: str) -> Any:
        executor = submitit.AutoExecutor(
            self._folder, self._cluster, slurm_max_num_timeout=_TIMEOUTS
        )
        try:
            executor.update_parameters(name=name, **self._parameters)
        except (NameError, ValueError, AssertionError, TypeError) as error:
            raise ConfigError(f"launcher_kwargs of cluster/slurm: {error}") from error
        return executor

    def _write_token(self, token: str) -> None:
        descriptor = os.open(self._folder / TOKEN, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(token)

    def _jobs_left(self) -> bool:
        states = [self.state_of(handle.job, 0.0) for handle in self._handles.values()]
        return any(not state.is_over for state in states)


class JobHandle(ClientHandle):
    """A client that runs as a job.

    Attributes:
        job: The submitit job.
    """

    def __init__(
        self, instance_id: int, job: Any, launcher: SlurmLauncher, folder: Path, runs: int
    ) -> None:
        """Store the arguments.

        Args:
            instance_id: Number of the instance, from 1.
            job: The submitit job.
            launcher: Queries the queue.
            folder: The run's folder.
            runs: How often the job had been requeued when it got this client.
        """
        self.instance_id, self.job = instance_id, job
        self._launcher, self._folder, self._runs = launcher, folder, runs
        self._status: int | None = None
        self._said = ""
        self._began = time.monotonic()

    def look(self, max_age: float) -> JobState:
        """Return the state of the job in the queue, at most `max_age` s old."""
        return self._launcher.state_of(self.job, max_age)

    def runs_again(self) -> bool:
        """Return whether Slurm has ended this client and requeued its job."""
        state = self.look(_SOON)
        return not state.is_over and state.runs > self._runs

    def exit_status(self) -> int | None:
        """Return the exit status: see `ClientHandle.exit_status`."""
        return self._find_status(_RARELY)

    def wait(self, until: float) -> bool:
        """Wait for the end of the client: see `ClientHandle.wait`."""
        while self._find_status(_SOON) is None:
            if time.monotonic() >= until:
                return False
            time.sleep(_PAUSE)
        return True

    def stderr(self) -> str:
        """Return the last lines of its standard error: see `ClientHandle.stderr`."""
        return self._said

    def state(self) -> str:
        """Return what it waits for: see `ClientHandle.state`."""
        state = self.look(_RARELY)
        return f"job {self.job.job_id} is {state.name} ({state.reason})"

    def is_queued(self) -> bool:
        """Return whether it is queued: see `ClientHandle.is_queued`."""
        if not self.look(_RARELY).is_queued:
            return False
        most = self._launcher.queue_time
        if time.monotonic() - self._began < most:
            return True
        said = f"{self.state()}, queued for longer than queue_time, {most:g} s"
        self._end(_INTERRUPTED, said)
        return False

    def terminate(self) -> None:
        """Ask the client to exit, unless Slurm requeues its job: see `ClientHandle.terminate`."""
        if self._find_status(0.0) is None:
            self._launcher.interrupt(self.job)

    def kill(self) -> None:
        """End the job, unless Slurm requeues it: see `ClientHandle.kill`."""
        if self._find_status(0.0) is None:
            self._launcher.cancel(self.job)

    def _find_status(self, max_age: float) -> int | None:
        if self._status is not None:
            return self._status
        state = self.look(max_age)
        if state.is_unschedulable:
            self._launcher.cancel(self.job)
            text = f"Slurm cannot give job {self.job.job_id} what it requests ({state.reason})."
            self._end(1, f"{text} {_ADVICE}")
            return self._status
        noted = self._read_note() if max_age < _RARELY or state.is_over else None
        if state.runs > self._runs:
            self._end(_INTERRUPTED, f"Slurm interrupted and requeued job {self.job.job_id}.")
        elif noted is not None:
            self._end(*noted)
        elif state.is_over:
            text = f"Slurm: job {self.job.job_id} is {state.name} ({state.reason})"
            self._end(0 if state.name in ("COMPLETED", "FINISHED") else 1, text)
        return self._status

    def _end(self, status: int, said: str) -> None:
        self._status, self._said = status, said

    def _read_note(self) -> tuple[int, str] | None:
        """Return the exit status and last lines that the job recorded, if its client has ended."""
        try:
            text = files.read_content(status_file(self._folder, self.instance_id), 1 << 20)
            status, _, said = text.decode(errors="replace").partition("\n")
            return int(status), said
        except (OSError, ValueError):
            return None


@contextlib.contextmanager
def _without_token() -> Iterator[None]:
    """Keep the run's secret out of the jobs' environments, which Slurm stores."""
    token = os.environ.pop(TOKEN_VARIABLE, None)
    try:
        yield
    finally:
        if token is not None:
            os.environ[TOKEN_VARIABLE] = token
