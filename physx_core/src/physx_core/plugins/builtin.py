"""The plugin ``physx``: what the core itself brings, through the same hooks as any plugin."""

from __future__ import annotations

from physx_core.plugins.hookspecs import Components, hookimpl


@hookimpl
def physx_launchers() -> Components:
    """Return the launchers; they are imported when clients are started."""
    return {
        "subprocess": "physx_core.workers.processes.launchers:SubprocessLauncher",
        "manual": "physx_core.workers.processes.launchers:ManualLauncher",
    }
