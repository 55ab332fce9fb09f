"""Executor: starts the processes of trials and reports which have ended."""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path

from physx_core import Closeable
from physx_core.processes import ChildProcess, describe_exit

PATIENCE = 20.0
"""Time in s that a trial has to write a checkpoint when it is asked to end."""


class Job(Closeable):
    """The process of a trial, wherever it runs. Closing it ends it."""

    @abstractmethod
    def has_ended(self) -> bool:
        """Return whether the process has ended."""

    @abstractmethod
    def describe_end(self) -> str:
        """Describe how it ended, for example ``was killed by signal 9 (SIGKILL)``."""


class Executor(Closeable):
    """Runs the processes of trials. Closing it ends those that are still running.

    It is made with the study's ``run.options`` and the number of threads of each trial's numerical
    libraries.

    Attributes:
        interval: Time in s between checks of the jobs.
    """

    interval: float

    @abstractmethod
    def start(self, folder: Path) -> Job:
        """Start the process of the trial in a folder, given as an absolute path.

        Raises:
            PhysxError: If the process cannot be started.
        """


def command_of(folder: Path) -> list[str]:
    """Return the command that runs a trial in the working directory of this process."""
    return [sys.executable, "-m", "physx_cluster.sweep.trial", str(folder), str(Path.cwd())]


def start_process(
    words: Sequence[str], variables: Mapping[str, str], output: str | Path
) -> ChildProcess:
    """Start a process whose output is appended to a file.

    Args:
        words: Its command.
        variables: Its further environment variables.
        output: The file.
    """
    with Path(output).open("ab") as file:
        place = file.fileno()
        return ChildProcess(words, variables=variables, stdout=place, stderr=place)


def variables_of(threads: int) -> dict[str, str]:
    """Return the environment variables of a trial's process.

    Args:
        threads: Number of threads of its numerical libraries.
    """
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return dict.fromkeys(names, str(threads))


def describe_status(status: int | None) -> str:
    """Describe how a process ended, given its exit status if known."""
    return "ended for an unknown reason" if status is None else describe_exit(status)
