"""RayExecutor: each trial is a task of Ray."""

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
from physx_core.errors import ConfigError, MissingLibraryError
from physx_core.processes import ChildProcess


class RayExecutor(Executor):
    """Runs each trial in a process beside a worker of Ray, on whatever node Ray chooses.

    All nodes need the study's folder and the sweep's working directory under the same path, as a
    shared disk provides them. A trial whose node is lost is continued on another one.
    """

    interval = 0.2

    def __init__(self, options: Mapping[str, Any], threads: int) -> None:
        """Connect to the cluster: see `RayConnection`.

        Args:
            options: Options of Ray's tasks, for example ``num_cpus``, and ``address``.
            threads: Threads of each trial; also what ``num_cpus`` is by default.

        Raises:
            MissingLibraryError: If Ray is not installed.
            ConfigError: If the cluster cannot be reached, or Ray refuses the options.
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
            raise ConfigError(f"Ray refuses the options of the executor: {error}") from None
        self._jobs: list[RayJob] = []

    def start(self, folder: Path) -> RayJob:
        """Start the task of a trial; see `Executor.start`."""
        words, output = command_of(folder), str(folder / OUTPUT)
        job = RayJob(self._ray, self._task.remote(words, self._variables, output))
        self._jobs = [each for each in self._jobs if not each.has_ended()]
        self._jobs.append(job)
        return job

    def close(self) -> None:
        """End all tasks, in order, and leave the cluster."""
        jobs = [job for job in getattr(self, "_jobs", []) if not job.has_ended()]
        for job in jobs:
            job.ask_to_end()
        if jobs:
            self._ray.wait([job.result for job in jobs], num_returns=len(jobs), timeout=PATIENCE)
        self._connection.close()


class RayJob(Job):
    """The task of a trial.

    Attributes:
        result: Ray's reference to its exit status.
    """

    def __init__(self, ray: Any, result: Any) -> None:
        self._ray, self.result = ray, result

    def has_ended(self) -> bool:
        """Return whether it has ended, or its node is lost."""
        ended, _ = self._ray.wait([self.result], timeout=0)
        return bool(ended)

    def describe_end(self) -> str:
        """Return its exit status in words, or what Ray says."""
        try:
            return describe_status(self._ray.get(self.result))
        except self._ray.exceptions.RayError as error:
            return f"was lost by Ray ({type(error).__name__})"

    def ask_to_end(self) -> None:
        """Ask it to end, without waiting."""
        with contextlib.suppress(self._ray.exceptions.RayError):
            self._ray.cancel(self.result)

    def close(self) -> None:
        """End it."""
        self.ask_to_end()
        self._ray.wait([self.result], timeout=PATIENCE)


def run_command(command: Sequence[str], variables: Mapping[str, str], output: str) -> int | None:
    """Run a command in a process of its own, on Ray's node, and return its exit status.

    Args:
        command: The words of the command.
        variables: Environment variables beside those of the worker.
        output: File that its output is appended to.
    """
    with Path(output).open("ab") as file:
        place = file.fileno()
        process = ChildProcess(command, variables=variables, stdout=place, stderr=place)
    try:
        while process.wait(0.1) is None:
            pass  # between two looks Ray can cancel the task, which raises KeyboardInterrupt here
        return process.exit_status()
    finally:
        process.close(PATIENCE)
