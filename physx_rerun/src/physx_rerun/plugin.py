"""Hooks of the plugin ``rerun``."""

from __future__ import annotations

from physx_core.plugins import hookimpl


@hookimpl
def physx_visualizers() -> dict[str, str]:
    """Return the visualizer as a reference, so Rerun is imported on first use."""
    return {"rerun": "physx_rerun.visualizer:RerunVisualizer"}
