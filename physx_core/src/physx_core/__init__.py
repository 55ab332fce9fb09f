"""physx connects C++ physics engines with deep learning.

The names for users: pipelines, configurations, datasets, world descriptions, and the base classes
of components. They are imported on first use to keep ``import physx_core`` fast.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
