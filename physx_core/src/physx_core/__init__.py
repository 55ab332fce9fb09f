"""physx connects C++ physics engines with deep learning.

The public names are imported when they are first used, so that ``import physx_core`` stays quick.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
