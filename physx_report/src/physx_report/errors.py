"""Errors of this package."""

from __future__ import annotations

from physx_core.errors import PhysxError


class ReportError(PhysxError):
    """A section of a report failed."""
