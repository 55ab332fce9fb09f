"""Waiting awake: a processor core that sleeps takes longer to wake than an answer takes to come."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")
_let_others: Callable[[], None] = getattr(os, "sched_yield", lambda: None)


def has_core_for_each(clients: int) -> bool:
    """Return whether waiting awake takes no core from a client that could compute."""
    if hasattr(os, "sched_getaffinity"):
        return clients <= len(os.sched_getaffinity(0))
    return clients <= (os.cpu_count() or 1)


def awaited(look: Callable[[], Found], seconds: float) -> Found:
    """Return what there is; look for it again and again as long as there is nothing.

    Args:
        look: Returns at once what is there; what is false is nothing.
        seconds: How long to look. Other processes may use the core meanwhile.
    """
    found, until = look(), time.monotonic() + seconds
    while not found and time.monotonic() < until:
        _let_others()
        found = look()
    return found
