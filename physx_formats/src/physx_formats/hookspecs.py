"""The hook that returns file formats."""

from __future__ import annotations

from physx_core.plugins import Components, kind_hook


@kind_hook("physx_formats:Format")
def physx_formats() -> Components:  # type: ignore[empty-body]
    """Return instances of `physx_formats.Format` by name."""
