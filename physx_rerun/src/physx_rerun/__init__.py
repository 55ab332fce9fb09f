"""The physx plugin ``rerun``: shows environments and training in the Rerun viewer.

The public names are imported on first use, so discovering the plugin does not import Rerun.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
