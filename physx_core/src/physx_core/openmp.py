"""Limits how long idle OpenMP threads spin.

After each parallel region, the threads of a library such as PyTorch spin for a few milliseconds in
case more work follows. During that time they take cores from environments in other processes.
"""

from __future__ import annotations

import os

_SPINS = "30000"
"""A tenth of GNU's default: long enough to reach a network's next layer, too short to delay a
simulation. About a millisecond on processors whose pause instruction takes long."""


def limit_openmp_spin() -> None:
    """Make GNU OpenMP's threads sleep soon after their work, unless the user set a wait policy.

    This affects libraries loaded from now on, in this process and in those that it starts.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _SPINS)
