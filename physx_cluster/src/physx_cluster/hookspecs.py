"""The hook that returns what runs the trials of sweeps."""

from __future__ import annotations

from physx_core.plugins import Components, kind_hook


@kind_hook("physx_cluster.sweep:Executor")
def physx_trial_executors() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_cluster.sweep.Executor` by name."""
