"""The physx plugin ``torch``: PyTorch networks, optimization and transformation.

The public names are imported on first use, so discovering the plugin does not import torch.
"""

from __future__ import annotations

import lazy_loader

from physx_core import limit_openmp_spin

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

limit_openmp_spin()
