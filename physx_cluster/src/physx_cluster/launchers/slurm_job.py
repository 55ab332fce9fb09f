"""ClientJob: the work of a Slurm job, the client of one instance."""

from __future__ import annotations

import os
import select
from pathlib import Path

from submitit.helpers import DelayedSubmission

from physx_core import files
from physx_core.net import TOKEN_VARIABLE
from physx_core.workers import ClientProcess

TOKEN = "token"
"""Name of the file with the run's secret."""


def status_file(folder: Path, instance: int) -> Path:
    """Return the file in which a job records its client's exit status and last lines."""
    return folder / f"{instance}.status"


def interruptions_file(folder: Path, instance: int) -> Path:
    """Return the file that gets one byte each time the job is interrupted and requeued."""
    return folder / f"{instance}.interruptions"


class ClientJob:
    """Runs an instance's client as a child process, which ends with the job.

    submitit pickles it for the job. It contains no secret: the token is in a separate file.
    """

    def __init__(self, folder: Path, instance: int, address: str) -> None:
        """Store the arguments.

        Args:
            folder: The run's folder, accessible only to its owner.
            instance: Number of the instance, from 1.
            address: ``HOST:PORT`` of the run's server.
        """
        self.folder, self.instance, self.address = folder, instance, address

    def __call__(self) -> None:
        """Run the client and record how it ended."""
        os.environ.pop(TOKEN_VARIABLE, None)
        token = files.read_content(self.folder / TOKEN, 1 << 16).decode()
        client = ClientProcess(self.instance, self.address, token)
        client.start()
        try:
            _wait(client.pid or 0)
        finally:
            status = client.exit_status()
            client.kill()
        note = f"{status}\n{client.stderr()}"
        files.replace(status_file(self.folder, self.instance), note.encode(), wait=False)

    def checkpoint(self) -> DelayedSubmission:
        """Record the interruption and have the job requeued; called by submitit."""
        with interruptions_file(self.folder, self.instance).open("ab") as file:
            file.write(b".")
        return DelayedSubmission(self)


def _wait(process: int) -> None:
    """Wait until a child process ends, without reaping it."""
    descriptor = os.pidfd_open(process)
    try:
        select.select([descriptor], [], [])
    finally:
        os.close(descriptor)
