"""Base classes of the components that plugins implement and pipelines use.

A plugin derives its environments, networks, optimizations, transformations, visualizers,
launchers, buffers and samplers from these.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
