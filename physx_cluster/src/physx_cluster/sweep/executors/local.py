"""LocalExecutor: trials in processes on this machine."""

from __future__ import annotations

from collections.abc import Mapping
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
from physx_core.errors import UnknownOptionError
from physx_core.processes import ChildProcess


class LocalExecutor(Executor):
    """Runs each trial in a process on this machine, which ends with this process."""

    interval = 0.05

    def __init__(self, options: Mapping[str, Any], threads: int) -> None:
        """Validate and store the options.

        Args:
            options: Must be empty.
            threads: Threads of each trial.

        Raises:
            UnknownOptionError: If an option is given.
        """
        if options:
            raise UnknownOptionError('The executor "local"', options, ())
        self._variables = variables_of(threads)
        self._jobs: list[LocalJob] = []

    def start(self, folder: Path) -> LocalJob:
        """Start the process of a trial; see `Executor.start`."""
        process = start_process(command_of(folder), self._variables, folder / OUTPUT)
        self._jobs = [job for job in self._jobs if not job.has_ended()]
        self._jobs.append(LocalJob(process))
        return self._jobs[-1]

    def close(self) -> None:
        """End all processes gracefully: each writes a checkpoint."""
        for job in self._jobs:
            job.ask_to_end()
        for job in self._jobs:
            job.close()


class LocalJob(Job):
    """The process of a trial on this machine.

    Attributes:
        process: The process.
    """

    def __init__(self, process: ChildProcess) -> None:
        self.process = process

    def has_ended(self) -> bool:
        """Return whether it has ended."""
        return self.process.exit_status() is not None

    def describe_end(self) -> str:
        """Describe its exit status."""
        return describe_status(self.process.exit_status())

    def ask_to_end(self) -> None:
        """Ask it to end, without waiting."""
        self.process.ask_to_end()

    def close(self) -> None:
        """End the process."""
        if not self.has_ended():
            self.process.close(PATIENCE)
