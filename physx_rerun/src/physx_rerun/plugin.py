"""What physx finds when the plugin `rerun` is selected."""

from __future__ import annotations

from physx_core.plugins import hookimpl


@hookimpl
def physx_visualizers() -> dict[str, str]:
    """Return the visualizer, as a text so that Rerun is imported when it is first used."""
    return {"rerun": "physx_rerun.visualizer:RerunVisualizer"}
