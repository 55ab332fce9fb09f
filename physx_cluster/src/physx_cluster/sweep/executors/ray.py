"""RayExecutor: each trial is a Ray task."""

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
    start_process,
    variables_of,
)
from physx_cluster.sweep.results import OUTPUT
from physx_core.errors import ConfigError, MissingLibraryError


class RayExecutor(Executor):
    """Runs each trial in a process next to a Ray worker, on a node that Ray chooses.

    All nodes need the study's folder and the sweep's working directory under the same path, as on a
    shared disk. If a trial's node is lost, the trial resumes on another node.
    """

    interval = 0.2

    def __init__(self, options: Mapping[str, Any], threads: int) -> None:
        """Connect to the cluster: see `RayConnection`.

        Args:
            options: Options of Ray tasks, for example ``num_cpus``, and ``address``.
            threads: Threads of each trial; also the default of ``num_cpus``.

        Raises:
            MissingLibraryError: If Ray is not installed.
            ConfigError: If the cluster cannot be reached, or Ray rejects the options.
        """
        try:
            import ray
        except ImportError:
            raise MissingLibraryError('The executor "ray"', "ray", "ray", "physx-cluster") from None
        task = {"num_cpus": threads, **options, "max_retries": 0}
        address = task.pop("address", None)
        self._ray, self._variables = ray, variables_of(threads)
        from physx_cluster.launchers.ray_connection import RayConnection

        self._connection = RayConnection(address)
        try:
            self._task = ray.remote(run_command).options(**task)
        except (TypeError, ValueError) as error:
            self.close()
            raise ConfigError(f"Ray rejects the options of the executor: {error}") from None
        self._jobs: list[RayJob] = []

    def start(self, folder: Path) -> RayJob:
        """Start the task of a trial; see `Executor.start`."""
        words, output = command_of(folder), str(folder / OUTPUT)
        job = RayJob(self._ray, self._task.remote(words, self._variables, output))
        self._jobs = [each for each in self._jobs if not each.has_ended()]
        self._jobs.append(job)
        return job

    def close(self) -> None:
        """End all tasks gracefully, and disconnect from the cluster."""
        jobs = [job for job in getattr(self, "_jobs", []) if not job.has_ended()]
        for job in jobs:
            job.ask_to_end()
        if jobs:
            self._ray.wait([job.result for job in jobs], num_returns=len(jobs), timeout=PATIENCE)
        self._connection.close()


class RayJob(Job):
    """The task of a trial.

    Attributes:
        result: Ray's reference to the exit status.
    """

    def __init__(self, ray: Any, result: Any) -> None:
        self._ray, self.result = ray, result

    def has_ended(self) -> bool:
        """Return whether the task has ended or its node was lost."""
        ended, _ = self._ray.wait([self.result], timeout=0)
        return bool(ended)

    def describe_end(self) -> str:
        """Describe its exit status, or Ray's error."""
        try:
            return describe_status(self._ray.get(self.result))
        except self._ray.exceptions.RayError as error:
            return f"was lost by Ray ({type(error).__name__})"

    def ask_to_end(self) -> None:
        """Ask it to end, without waiting."""
        with contextlib.suppress(self._ray.exceptions.RayError):
            self._ray.cancel(self.result)

    def close(self) -> None:
        """End the task."""
        self.ask_to_end()
        self._ray.wait([self.result], timeout=PATIENCE)


def run_command(command: Sequence[str], variables: Mapping[str, str], output: str) -> int | None:
    """Run a command in a separate process on Ray's node, and return its exit status.

    Args:
        command: Words of the command.
        variables: Environment variables in addition to the worker's.
        output: File to append the output to.
    """
    process = start_process(command, variables, output)
    try:
        while process.wait(0.1) is None:
            pass  # between polls, Ray can cancel the task, which raises KeyboardInterrupt here
        return process.exit_status()
    finally:
        process.close(PATIENCE)
