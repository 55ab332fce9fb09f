"""The physx plugin ``viser``: a hand on running environments, in a browser.

The public names are imported on first use, so discovering the plugin does not import viser.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
