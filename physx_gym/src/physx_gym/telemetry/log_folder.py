"""Temporary folder of logs."""

from __future__ import annotations

import collections
from pathlib import Path
from typing import Any

from physx_core.processes import TemporaryFolder

KEPT = 32
"""Number of logs that are kept."""


class LogFolder:
    """A temporary folder that is created when it is first needed."""

    def __init__(self) -> None:
        self._folder: TemporaryFolder | None = None
        self._paths: collections.deque[Path] = collections.deque()
        self._count = 0

    def __getstate__(self) -> dict[str, Any]:
        """Return nothing: a copy uses its own folder."""
        return {}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Start without a folder."""
        LogFolder.__init__(self)

    def new_path(self, name: str) -> Path:
        """Return the path of the next log, and delete all but the newest `KEPT`.

        Args:
            name: Prefix of its name.
        """
        if self._folder is None:
            self._folder = TemporaryFolder("logs-")
        if len(self._paths) == KEPT:
            self._paths.popleft().unlink(missing_ok=True)
        self._count += 1
        self._paths.append(self._folder.path / f"{name}_{self._count:06}.h5")
        return self._paths[-1]

    def close(self) -> None:
        """Delete the folder."""
        if self._folder is not None:
            self._folder.close()
        self._folder = None
        self._paths.clear()
