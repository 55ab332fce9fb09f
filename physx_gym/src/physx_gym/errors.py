"""The error of episodes' logs."""

from __future__ import annotations

from physx_core.errors import PhysxError


class LogError(PhysxError):
    """An episode's log is missing, damaged, or lacks the requested data."""
