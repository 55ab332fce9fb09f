"""StudyError: what a user can put right about a sweep."""

from __future__ import annotations

from physx_core.errors import PhysxError


class StudyError(PhysxError):
    """A study cannot be begun, continued or shown, or trials of it ended without a result."""
