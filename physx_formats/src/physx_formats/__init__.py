"""Exports datasets to files of other formats, and imports them, block by block.

The formats are components: a plugin adds one with the hook ``physx_formats``.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
