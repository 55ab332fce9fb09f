"""Hooks of the plugin ``cluster``; components are references, imported on use."""

from __future__ import annotations

from physx_core.plugins import Components, hookimpl


@hookimpl
def physx_launchers() -> Components:
    """Return the launchers by name."""
    return {
        "ray": "physx_cluster.launchers.ray:RayLauncher",
        "slurm": "physx_cluster.launchers.slurm:SlurmLauncher",
    }


@hookimpl
def physx_trial_executors() -> Components:
    """Return the executors of a sweep's trials by name."""
    return {
        "local": "physx_cluster.sweep.executors.local:LocalExecutor",
        "ray": "physx_cluster.sweep.executors.ray:RayExecutor",
        "slurm": "physx_cluster.sweep.executors.slurm:SlurmExecutor",
    }
