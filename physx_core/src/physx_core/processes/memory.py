"""Memory that processes share."""

from __future__ import annotations

import os
import tempfile
from typing import IO


def anonymous_file(name: str) -> IO[bytes]:
    """Return a file for processes to map that get its descriptor, in memory where that is possible.

    It has no place in a file system, so it is gone with the last process that has it open, however
    that ends, and is not limited by the size of ``/dev/shm``.

    Args:
        name: What the system shows as its name.
    """
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create(name), "r+b", buffering=0)
    return tempfile.TemporaryFile(buffering=0)
