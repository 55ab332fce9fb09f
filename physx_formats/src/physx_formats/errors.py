"""The errors of imports and exports."""

from __future__ import annotations

from physx_core.errors import DatasetError


class ExchangeError(DatasetError):
    """Rows cannot be exported to or imported from a file of another format."""
