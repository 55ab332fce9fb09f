"""The plugin ``agree``."""

from __future__ import annotations

from physx_core.plugins import Components, hookimpl


@hookimpl
def physx_report_sections() -> Components:
    """Return the section of reports on how far engines agree."""
    return {"agreement": "physx_agree.section:SECTION"}
