"""Memory shared between processes."""

from __future__ import annotations

import os
import tempfile
from typing import IO


def anonymous_file(name: str) -> IO[bytes]:
    """Return a file, in memory if possible, that processes can map given its descriptor.

    It has no path, so it disappears with the last process that has it open, however that ends, and
    it is not limited by the size of ``/dev/shm``.

    Args:
        name: Name that the system displays for it.
    """
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create(name), "r+b", buffering=0)
    return tempfile.TemporaryFile(buffering=0)
