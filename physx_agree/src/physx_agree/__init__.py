"""Agreement of physics engines: how far they agree on a task, and why they part."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
