"""The hook that returns physics engines."""

from __future__ import annotations

from physx_core.plugins import Components, kind_hook


@kind_hook("physx_sim:Backend", is_instance=True)
def physx_backends() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_sim.Backend` by name."""
