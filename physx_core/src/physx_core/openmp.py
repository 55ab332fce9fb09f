"""Limits how long idle OpenMP threads spin.

After each parallel region, the threads of a library such as PyTorch spin for a few milliseconds in
case more work follows. Meanwhile they take processor cores from the environments that run in
processes of their own.
"""

from __future__ import annotations

import os

_SPINS = "30000"
"""A tenth of GNU's own: long enough to reach a network's next layer, too short to delay a
simulation. It is about a millisecond where a processor pauses for long in each turn."""


def limit_openmp_spin() -> None:
    """Let GNU OpenMP's threads sleep soon after their work, unless the user set a wait policy.

    This applies to libraries loaded from now on, in this process and in those that it starts.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _SPINS)
