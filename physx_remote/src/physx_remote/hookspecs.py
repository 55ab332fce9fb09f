"""The hook that returns protocols."""

from __future__ import annotations

from physx_core.plugins import Components, kind_hook


@kind_hook("physx_remote:Protocol")
def physx_protocols() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_remote.Protocol` by name."""
