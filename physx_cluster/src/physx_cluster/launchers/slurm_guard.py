"""Guard: ends a run's jobs and removes its folder once the run has ended, even if killed.

Started as ``python -m physx_cluster.launchers.slurm_guard DESCRIPTOR FOLDER NAME``. The descriptor
belongs to a pipe to which only the run can write, so it closes with the run, even by SIGKILL.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

_PATIENCE = 20.0  # s, for jobs to leave the queue
_TERMINATION_GRACE = 3.0  # s, for processes to obey Ctrl-C, which they ignore if the run did
_PAUSE = 0.1
# Modules that submitit's local executor runs, compared as whole words: a path may contain them.
_MODULES = {b"submitit.local._local", b"submitit.core._submit"}


class Guard:
    """The process that ends a run's jobs, once it is told to or this process ends."""

    def __init__(self, folder: Path, name: str) -> None:
        """Start it.

        Args:
            folder: The run's folder.
            name: Name of its jobs in Slurm's queue; empty if they are local processes.
        """
        from physx_core.processes import ChildProcess

        reading, self._pipe = os.pipe()
        module = "physx_cluster.launchers.slurm_guard"
        words = [sys.executable, "-P", "-m", module, str(reading), str(folder), name]
        try:
            self._process = ChildProcess(words, pass_fds=[reading], detached=True)
        finally:
            os.close(reading)

    def close(self) -> None:
        """Have it end the jobs, as if this process had been killed, and wait until it has."""
        os.close(self._pipe)
        self._process.wait()


def main(descriptor: int, folder: Path, name: str) -> None:
    """Wait for the end of the run, then clean up.

    Args:
        descriptor: Read end of the pipe.
        folder: The run's folder.
        name: Name of its jobs in Slurm's queue; empty if they are local processes.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.read(descriptor, 1)
    until = time.monotonic() + _PATIENCE
    if name:
        _end_jobs(name, until)
    else:
        _end_processes(folder, time.monotonic() + _TERMINATION_GRACE)
    while folder.exists() and time.monotonic() < until:  # a job may still be writing
        shutil.rmtree(folder, ignore_errors=True)
        time.sleep(_PAUSE)


def _end_jobs(name: str, until: float) -> None:
    for words in (["--signal=KILL"], []):
        _run("scancel", "--quiet", *words, f"--name={name}")
    while time.monotonic() < until:
        if not _run("squeue", "--noheader", f"--name={name}").stdout.strip():
            return
        time.sleep(_PAUSE)


def _run(*words: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(words, capture_output=True, check=False)


def _end_processes(folder: Path, until: float) -> None:
    """End the jobs of submitit's local executor, whose command lines contain the folder."""
    while found := _processes_of(folder):
        late = time.monotonic() > until
        for process in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL if late else signal.SIGINT)
        time.sleep(_PAUSE)


def _processes_of(folder: Path) -> list[int]:
    mark, found = os.fsencode(folder), []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = (process / "cmdline").read_bytes().split(b"\0")
            if mark in words and _MODULES.intersection(words):
                found.append(int(process.name))
    return found


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
