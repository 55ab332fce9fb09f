"""The plugin ``identify``."""

from __future__ import annotations

from physx_core.plugins import Components, hookimpl


@hookimpl
def physx_report_sections() -> Components:
    """Return the section of reports on what was identified."""
    return {"identification": "physx_identify.result.section:SECTION"}
