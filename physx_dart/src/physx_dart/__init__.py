"""physx plugins `dart` and `pinocchio`: simulations of robots, and environments with them.

The public names are imported when they are first used, so that finding the plugins does not import
an engine.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
