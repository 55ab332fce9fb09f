"""Hooks of the plugin ``viser``."""

from __future__ import annotations

from physx_core.plugins import hookimpl


@hookimpl
def physx_visualizers() -> dict[str, str]:
    """Return the visualizer as a reference, so viser is imported on first use."""
    return {"viser": "physx_viser.visualizer:ViserVisualizer"}
