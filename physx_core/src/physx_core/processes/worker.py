"""Setup of worker processes: environment variables, signals, and descriptions of exit statuses."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import signal

CLIENT_VARIABLE = "PHYSX_CLIENT"
"""Environment variable set in every process that runs environments for another process."""


def worker_variables() -> dict[str, str]:
    """Return the environment variables of a process that shares the processor cores with others.

    Numerical libraries must not use all cores in each process.
    """
    return {CLIENT_VARIABLE: "1", "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}


def prepare_worker(*, preempts: bool = False) -> None:
    """Leave ending this process to the one that started it, and report failures on stderr.

    Ctrl-C does nothing, and a crash or SIGTERM prints a traceback.

    Args:
        preempts: Whether this process, when it is woken, takes the core from a process that only
            computes: then its answers come soon on a busy machine.
    """
    faulthandler.enable()
    faulthandler.register(signal.SIGTERM, all_threads=False, chain=True)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "SCHED_BATCH") and not preempts:
        # Waking it does not preempt its starter, which wakes others.
        with contextlib.suppress(OSError):  # not every container allows it
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
