"""Detection of a display."""

from __future__ import annotations

import os
import sys


def has_display() -> bool:
    """Return whether windows can be opened."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
