"""The error of sweeps."""

from __future__ import annotations

from physx_core.errors import PhysxError


class StudyError(PhysxError):
    """A study cannot be started, continued, or shown, or some of its trials have no result."""
