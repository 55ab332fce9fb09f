"""physx plugin `rerun`: shows environments and training in the Rerun viewer.

The public names are imported when they are first used, so that finding the plugin does not import
Rerun.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from physx_rerun.headless import render_picture
    from physx_rerun.visualizer import RerunVisualizer

__version__ = "0.1.0"

_HOMES = {"RerunVisualizer": "visualizer", "render_picture": "headless"}

__all__ = ["RerunVisualizer", "render_picture"]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"physx_rerun.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*globals(), *__all__])
