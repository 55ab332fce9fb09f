"""The queue of jobs: Slurm's, or the processes of submitit's local executor."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from physx_core.errors import ConfigError
from physx_core.processes import descendants_of

_SOON = ("PENDING", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "SPECIAL_EXIT", "CONFIGURING")
_NOW = ("RUNNING", "SUSPENDED", "STOPPED", "SIGNALING", "STAGE_OUT", "RESIZING")
_LEAVING = ("COMPLETING", "PREEMPTED")
_NEVER = (
    *("BadConstraints", "PartitionConfig", "PartitionNodeLimit", "PartitionTimeLimit"),
    *("InvalidAccount", "InvalidQOS"),
)  # reasons to wait that do not go away
_SECONDS = 10.0  # timeout of a Slurm command


@dataclass(frozen=True)
class JobState:
    """The state of a job in the queue.

    Attributes:
        name: Slurm's name for it.
        runs: How often the job was requeued.
        reason: Why it waits, or the node it runs on.
    """

    name: str
    runs: int = 0
    reason: str = ""

    @property
    def is_queued(self) -> bool:
        """Whether it is queued."""
        return self.name in _SOON

    @property
    def is_unschedulable(self) -> bool:
        """Whether it waits for something that it can never get."""
        return self.is_queued and self.reason in _NEVER

    @property
    def is_over(self) -> bool:
        """Whether it has ended and will not run again."""
        return self.name not in (*_SOON, *_NOW, *_LEAVING)


UNKNOWN_TO_SCHEDULER = JobState("COMPLETED")
"""State of a job that the queue no longer knows: it ended some time ago."""


class Queue(Protocol):
    """Queries the states of all of a run's jobs at once, and ends jobs."""

    def states(self) -> dict[str, JobState] | None:
        """Return the states of the jobs by name; None: the queue is not answering."""

    def interrupt(self, job: Any) -> None:
        """Ask a job's client to exit."""

    def cancel(self, jobs: Iterable[Any]) -> None:
        """End jobs immediately, running or queued."""


class SlurmQueue:
    """Slurm's queue.

    Attributes:
        name: Name of all jobs of the run.
    """

    def __init__(self, name: str) -> None:
        """Store the name."""
        self.name = name

    def states(self) -> dict[str, JobState] | None:
        """Return the states: see `Queue.states`."""
        form = "JobArrayID:32,State:32,RestartCnt:16,Reason:64,NodeList:64"
        words = ["--noheader", "--array", "--states=all", f"--name={self.name}"]
        done = _run("squeue", *words, f"--Format={form}")
        if done.returncode:
            return None
        return dict(map(_parse, filter(str.strip, done.stdout.splitlines())))

    def interrupt(self, job: Any) -> None:
        """Send SIGTERM to the job's processes: see `Queue.interrupt`."""
        _run("scancel", "--quiet", "--signal=TERM", job.job_id)

    def cancel(self, jobs: Iterable[Any]) -> None:
        """End jobs immediately: see `Queue.cancel`."""
        if names := [job.job_id for job in jobs]:
            _run("scancel", "--quiet", "--signal=KILL", *names)
            _run("scancel", "--quiet", *names)


class LocalQueue:
    """The processes of submitit's local executor.

    Attributes:
        jobs: The run's jobs by instance.
    """

    def __init__(self, folder: Path) -> None:
        """Store the run's folder."""
        self._folder = folder
        self._interrupted: set[str] = set()
        self.jobs: dict[int, Any] = {}

    def states(self) -> dict[str, JobState]:
        """Return the states: see `Queue.states`."""
        from physx_cluster.launchers.slurm_job import interruptions_file

        found = {}
        for number, job in self.jobs.items():
            file = interruptions_file(self._folder, number)
            runs = file.stat().st_size if file.exists() else 0
            found[job.job_id] = JobState(job.state, runs, "this machine")
        return found

    def interrupt(self, job: Any) -> None:
        """End the job within a second: see `Queue.interrupt`."""
        if job.job_id in self._interrupted:  # a second interrupt would cut its cleanup short
            return
        self._interrupted.add(job.job_id)
        if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # so its processes ignore it too
            _kill(int(job.job_id))
        else:
            job.cancel()

    def cancel(self, jobs: Iterable[Any]) -> None:
        """End jobs: see `Queue.cancel`."""
        for job in jobs:
            self.interrupt(job)


def find_controller() -> str:
    """Return the address of Slurm's controller.

    Raises:
        ConfigError: If Slurm is not installed here or does not answer.
    """
    done = _run("scontrol", "show", "config")
    found = re.search(r"^SlurmctldHost\[0\]\s*=\s*([^\s(]+)(?:\((\S+)\))?", done.stdout, re.M)
    if done.returncode or found is None:
        said = " ".join((done.stderr or done.stdout).split())
        raise ConfigError(
            f"Slurm does not answer: {said} Start the run where sbatch works, such as a login "
            "node, or run the jobs as processes of this machine with "
            'launcher_kwargs={"cluster": "local"}.'
        )
    return found[2] or found[1]


def _kill(process: int) -> None:
    for number in (process, *descendants_of(process)):
        with contextlib.suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)


def _parse(line: str) -> tuple[str, JobState]:
    job, state, runs, reason, *nodes = line.split()
    return job, JobState(state, int(runs), " ".join(nodes) or reason)


def _run(*words: str) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            words, capture_output=True, text=True, timeout=_SECONDS, check=False, errors="replace"
        )
    except FileNotFoundError:
        return subprocess.CompletedProcess(words, 127, "", f"{words[0]} is not installed.")
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(words, 124, "", f"{words[0]} does not answer.")
