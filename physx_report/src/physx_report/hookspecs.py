"""The hook that returns sections of reports."""

from __future__ import annotations

from physx_core.plugins import Components, kind_hook


@kind_hook("physx_report:Section")
def physx_report_sections() -> Components:  # type: ignore[empty-body]
    """Return instances of `physx_report.Section` by name."""
