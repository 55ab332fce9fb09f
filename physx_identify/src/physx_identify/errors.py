"""Errors of the identification of parameters."""

from __future__ import annotations

from physx_core.errors import PhysxError


class IdentificationError(PhysxError):
    """A log or a robot that parameters cannot be identified from."""
