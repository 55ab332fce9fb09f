"""Finds and kills the processes that this one started and all of their descendants."""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path

from physx_core.processes.watchdog import WATCHDOG


def kill_descendants() -> None:
    """Kill all descendants of this process, if there is a /proc file system.

    A client started by hand may share its process group with other programs of the user, so unlike
    a launched one, it cannot kill its whole group.
    """
    WATCHDOG.release()
    while found := descendants_of(os.getpid()):
        for number in found:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(number, signal.SIGKILL)


def children() -> set[int]:
    """Return the IDs of this process's children, if there is a /proc file system.

    They include zombies: children that have ended but have not been waited for.
    """
    found: set[int] = set()
    for thread in Path("/proc/self/task").glob("*"):
        with contextlib.suppress(OSError):  # the thread has ended
            found.update(map(int, (thread / "children").read_text().split()))
    return found


def descendants_of(ancestor: int) -> list[int]:
    """Return the IDs of a process's descendants, if there is a /proc file system."""
    children: dict[int, list[int]] = {}
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state, parent = (process / "stat").read_text().rpartition(")")[2].split()[:2]
            if state not in "ZX":  # not already dead
                children.setdefault(int(parent), []).append(int(process.name))
    found = children.get(ancestor, [])
    for number in found:  # grows while it is read
        found += children.get(number, [])
    return found
