"""Briefly busy-waits for a reply, because waking a sleeping processor core takes longer."""

from __future__ import annotations

import os
import platform
import threading
import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")

yield_core: Callable[[], None] = getattr(os, "sched_yield", lambda: None)
"""Yield this processor core to another waiting process."""


_LOCK = threading.Lock()
_IS_X86 = platform.machine() in ("x86_64", "AMD64", "i386", "i686")


def order() -> None:
    """Order shared-memory accesses: writes before this call precede later ones; reads likewise."""
    if not _IS_X86:  # x86 processors do so anyway
        yield_core()


def fence() -> None:
    """Full memory barrier: other processes see earlier writes before anything is read afterwards.

    It also orders writes and reads as `order` does.
    """
    if _IS_X86:
        with _LOCK:  # its atomic instruction is a full barrier
            pass
    else:
        yield_core()  # the scheduler executes a full barrier


def count_cores() -> int:
    """Return the number of processor cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def has_core_for_each(clients: int) -> bool:
    """Return whether one can spin without taking a core from a client that could compute."""
    return clients <= count_cores()


def spin_until(look: Callable[[], Found], seconds: float) -> Found:
    """Call a function repeatedly until it finds something, and return its last result.

    Args:
        look: Returns immediately; a false result means that nothing was found.
        seconds: How long to continue. Other processes may use the core meanwhile.
    """
    found, until = look(), time.monotonic() + seconds
    while not found and time.monotonic() < until:
        yield_core()
        found = look()
    return found
