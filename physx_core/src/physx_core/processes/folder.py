"""TemporaryFolder: a folder that is removed when this process ends."""

from __future__ import annotations

import os
import shutil
import weakref
from pathlib import Path

from physx_core.closeable import Closeable
from physx_core.processes.watchdog import WATCHDOG


class TemporaryFolder(Closeable):
    """A folder for temporary files that is removed when this process ends, even if it is killed.

    It is also removed when this object is closed or garbage-collected. A process forked from this
    one leaves it alone.

    Attributes:
        path: The folder.
    """

    def __init__(self, prefix: str) -> None:
        """Create the folder.

        Args:
            prefix: Prefix of its name.
        """
        self.path = WATCHDOG.make_folder(prefix)
        self._remove = weakref.finalize(self, _remove, self.path, os.getpid())
        self._remove.atexit = False  # at exit, the watchdog does it after all exit functions

    def close(self) -> None:
        """Remove the folder."""
        self._remove()


def _remove(path: Path, owner: int) -> None:
    if os.getpid() == owner:
        shutil.rmtree(path, ignore_errors=True)
        WATCHDOG.stop_if_idle()
