"""OpenMP: how long its threads stay awake once they have nothing to do.

A library that computes in several threads, such as PyTorch, leaves them spinning for a few
milliseconds after each piece of work, in case that more follows. They take the processor cores from
the environments that go on meanwhile in processes of their own.
"""

from __future__ import annotations

import os

_SPINS = "10000"
"""About 0.2 ms: long enough for the next layer of a network, too short to hold up a simulation."""


def rest_soon() -> None:
    """Have the threads of GNU's OpenMP sleep soon after their work, unless the user chose a time.

    It holds for libraries that are loaded from now on, in this process and those that it starts.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _SPINS)
