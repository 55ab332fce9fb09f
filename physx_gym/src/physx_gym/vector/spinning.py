"""Spinner: polls memory before it sleeps, for as long as that pays."""

from __future__ import annotations

import time
from collections.abc import Callable

from physx_core.net import yield_core

SPIN_TIME = 1e-3
"""How long a process polls for what it waits for before it sleeps, in s."""
_OTHERS = 1e-4  # s; a longer yield gave the core to another process
_MOST_RESTS = 1024


class Spinner:
    """Polls for what a process waits for, unless that was in vain lately.

    Waking a process that sleeps takes longer than to poll, as long as a core is free. On a busy
    machine, polling takes the core from the process that is waited for, and the system then lets
    the polling process wait for the time that it used. So whenever a spin ends without what it
    waited for, or another process used the core meanwhile, the next waits do not spin: first one,
    then twice as many each time.
    """

    def __init__(self, *, spins: bool) -> None:
        """Start.

        Args:
            spins: Whether to spin at all.
        """
        self._rests = 0  # after the next spin in vain
        self._left: float = 0 if spins else float("inf")

    def find(self, look: Callable[[], bool]) -> bool:
        """Poll, if that pays; return whether something was found.

        Args:
            look: Returns immediately whether it is there.
        """
        if self._left > 0:
            self._left -= 1
            return False
        before = time.monotonic()
        until = before + SPIN_TIME
        while True:
            yield_core()
            found, now = look(), time.monotonic()
            is_shared = now - before > _OTHERS
            if found and not is_shared:
                self._rests //= 2
                return True
            if found or is_shared or now > until:
                self._rests = min(2 * self._rests + 1, _MOST_RESTS)
                self._left = self._rests
                return found
            before = now
