"""Hooks of the plugin ``cluster``; components are references, imported on use."""

from __future__ import annotations

from physx_core.plugins import hookimpl


@hookimpl
def physx_launchers() -> dict[str, str]:
    """Return the launchers by name."""
    return {
        "ray": "physx_cluster.launchers.ray:RayLauncher",
        "slurm": "physx_cluster.launchers.slurm:SlurmLauncher",
    }
