"""The physx plugin ``cluster``: a run's clients on Ray and on Slurm.

The public names are imported on first use, so discovering the plugin imports no cluster library.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
