"""The plugin ``physx``: the core's own components, registered with the same hooks."""

from __future__ import annotations

from physx_core.plugins.hookspecs import Components, hookimpl


@hookimpl
def physx_launchers() -> Components:
    """Return the launchers, imported when clients are started."""
    return {
        "subprocess": "physx_core.workers.launchers:SubprocessLauncher",
        "manual": "physx_core.workers.launchers:ManualLauncher",
    }


@hookimpl
def physx_buffers() -> Components:
    """Return the buffers for training while environments generate."""
    return {
        "stream": "physx_core.buffers.stream:Stream",
        "reservoir": "physx_core.buffers.reservoir:Reservoir",
        "window": "physx_core.buffers.window:Window",
        "fifo": "physx_core.buffers.fifo:Fifo",
    }


@hookimpl
def physx_transformations() -> Components:
    """Return the default transformation of networks."""
    return {"identity": "physx_core.components.transformation:Transformation"}


@hookimpl
def physx_samplers() -> Components:
    """Return the samplers, imported when a run uses them."""
    return {
        "uniform": "physx_core.samplers.uniform:Uniform",
        "sobol": "physx_core.samplers.sequences:Sobol",
        "latin_hypercube": "physx_core.samplers.sequences:LatinHypercube",
        "grid": "physx_core.samplers.grid:Grid",
        "active": "physx_core.samplers.active:Active",
        "generator": "physx_core.samplers.generator:Generator",
        "table": "physx_core.samplers.table:Table",
    }
