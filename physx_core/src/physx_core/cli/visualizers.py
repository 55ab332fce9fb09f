"""Finds out which plugins draw."""

from __future__ import annotations

from physx_core import plugins
from physx_core.errors import PhysxError


def visualizer_plugins() -> list[str]:
    """Return the names of the installed plugins that contain nothing but visualizers."""
    found = []
    for name in plugins.available():
        try:
            components = plugins.load(name).components
        except PhysxError:  # `physx plugins` reports broken ones
            continue
        if components.keys() == {"visualizer"}:
            found.append(name)
    return found
