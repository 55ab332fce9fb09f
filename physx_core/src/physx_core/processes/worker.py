"""Set-up of worker processes: their variables and signals, and their exit status in words."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import signal

CLIENT_VARIABLE = "PHYSX_CLIENT"
"""Environment variable that is set in every process that runs environments for another one."""


def worker_variables() -> dict[str, str]:
    """Return the environment variables of a process that shares the processor cores with others.

    A numerical library must not take all of them for each process.
    """
    return {CLIENT_VARIABLE: "1", "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}


def prepare_worker() -> None:
    """Leave the end of this process to the one that started it, and say on stderr where it failed.

    That is: Ctrl-C does nothing, and a crash or SIGTERM prints a traceback.
    """
    faulthandler.enable()
    faulthandler.register(signal.SIGTERM, all_threads=False, chain=True)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "SCHED_BATCH"):  # when it wakes up, its starter may go on and wake the others
        with contextlib.suppress(OSError):  # not every container lets it choose
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def describe_exit(status: int) -> str:
    """Describe an exit status, negative for a signal."""
    if status >= 0:
        return f"ended with exit status {status}"
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = "unknown"
    return f"was killed by signal {-status} ({name})"
