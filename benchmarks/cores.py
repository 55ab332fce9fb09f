"""Separate processor cores for processes that answer each other."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator


def two_cores() -> list[int]:
    """Return two processor cores, or none if there are fewer or the system allows no choice."""
    cores = sorted(os.sched_getaffinity(0))[:2] if hasattr(os, "sched_getaffinity") else []
    return cores if len(cores) > 1 else []


@contextlib.contextmanager
def on_core(core: int | None) -> Iterator[None]:
    """Restrict this process to one processor core; None: any."""
    if core is None:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
