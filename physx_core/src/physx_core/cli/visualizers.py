"""Finds out which plugins draw."""

from __future__ import annotations

from physx_core import plugins
from physx_core.components.visualizer import takes_hand
from physx_core.errors import PhysxError


def visualizer_plugins() -> list[str]:
    """Return the names of the installed plugins that contain nothing but visualizers.

    If there are several, those are left out in which a person touches environments.
    """
    found = []
    for name in plugins.available():
        try:
            components = plugins.load(name).components
        except PhysxError:  # `physx plugins` reports broken ones
            continue
        if components.keys() == {"visualizer"}:
            found.append(name)
    if len(found) > 1:
        kept = [name for name in found if not takes_hand(plugins.resolve("visualizer", name))]
        found = kept or found
    return found
