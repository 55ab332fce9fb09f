"""Busy-wait briefly for a reply, because waking a sleeping processor core takes longer."""

from __future__ import annotations

import os
import platform
import threading
import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")

yield_core: Callable[[], None] = getattr(os, "sched_yield", lambda: None)
"""Let another process that waits for this processor core run."""


_LOCK = threading.Lock()
_IS_X86 = platform.machine() in ("x86_64", "AMD64", "i386", "i686")


def order() -> None:
    """Keep writes to shared memory before this call before those after it, and reads as well."""
    if not _IS_X86:  # whose processors do so anyway
        yield_core()


def fence() -> None:
    """Have other processes see what was written before this call before anything is read after it.

    It orders writes and reads as `order` does, too.
    """
    if _IS_X86:
        with _LOCK:  # its atomic instruction is a full barrier
            pass
    else:
        yield_core()  # a scheduler passes a full barrier


def count_cores() -> int:
    """Return how many processor cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def has_core_for_each(clients: int) -> bool:
    """Return whether spinning takes no core from a client that could compute."""
    return clients <= count_cores()


def spin_until(look: Callable[[], Found], seconds: float) -> Found:
    """Call a function again and again until it finds something, and return its last result.

    Args:
        look: Returns at once; a false result means that nothing was found.
        seconds: How long to go on. Other processes may use the core meanwhile.
    """
    found, until = look(), time.monotonic() + seconds
    while not found and time.monotonic() < until:
        yield_core()
        found = look()
    return found
