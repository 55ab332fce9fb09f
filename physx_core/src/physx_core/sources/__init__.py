"""Sources of samples: environments in this process, or in clients over TCP.

For programs that step environments without a pipeline, such as vectorized environments.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
