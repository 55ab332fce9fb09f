"""The plugin ``report``."""

from __future__ import annotations

from physx_core.plugins import Components, hookimpl


@hookimpl
def physx_report_sections() -> Components:
    """Return the sections of each report; those that do not apply to a run are empty."""
    return {
        "sweep": "physx_report.sections.sweep:SECTION",
        "policy": "physx_report.sections.policy:SECTION",
        "quality": "physx_report.sections.quality:SECTION",
        "rollouts": "physx_report.sections.rollouts:SECTION",
        "film": "physx_report.sections.film:SECTION",
        "episodes": "physx_report.sections.episodes:SECTION",
        "training": "physx_report.sections.training:SECTION",
        "samples": "physx_report.sections.samples:SECTION",
        "origin": "physx_report.sections.origin:SECTION",
    }
