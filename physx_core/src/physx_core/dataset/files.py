"""What the dataset asks of the file system: whole writes, atomic replacement, the writer's lock."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from physx_core.errors import DatasetError, DatasetLockedError
from physx_core.fields import Array

LOCK = "dataset.lock"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers that say: nothing more can be stored here."""


@contextlib.contextmanager
def storing(what: str) -> Iterator[None]:
    """Turn the system's errors into a `DatasetError` that says what could not be stored."""
    try:
        yield
    except OSError as error:
        reason = "the disk is full" if error.errno in FULL else (error.strerror or str(error))
        advice = " Free some space and open the dataset again." if error.errno in FULL else ""
        raise DatasetError(
            f"{what} cannot be stored: {reason}. All rows committed before are intact.{advice}"
        ) from error


def write_at(descriptor: int, content: bytes | memoryview, offset: int) -> None:
    """Write all of the content at an offset of an open file."""
    view = memoryview(content)
    while view:
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written


def read_at(descriptor: int, view: memoryview, offset: int) -> bool:
    """Fill a buffer from an offset of an open file; return whether the file reached that far."""
    while view:
        count = os.preadv(descriptor, [view], offset)
        if not count:
            return False
        view, offset = view[count:], offset + count
    return True


def raw(array: Array) -> memoryview:
    """Return the bytes of a contiguous array, without a copy."""
    return array.reshape(-1).view("u1").data


def temporary(path: Path) -> Path:
    """Return the name under which a file is written before it takes its place."""
    return path.with_name(path.name + ".tmp")


def replace(path: Path, content: bytes) -> None:
    """Write a file that is either the old or the new one, whole, whenever the process dies."""
    draft = temporary(path)
    try:
        descriptor = os.open(draft, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        try:
            write_at(descriptor, content, 0)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Bring the folder's names to the disk, so that a renamed file survives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def lock(directory: Path) -> int:
    """Take the writer's lock of a dataset and return its descriptor; closing that releases it.

    Raises:
        DatasetLockedError: Another writer has it.
    """
    import fcntl

    descriptor = os.open(directory / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.ftruncate(descriptor, 0)
        write_at(descriptor, str(os.getpid()).encode(), 0)
    except BlockingIOError:
        owner = os.pread(descriptor, 20, 0).decode(errors="replace") or "unknown"
        os.close(descriptor)
        raise DatasetLockedError(
            f"Process {owner} writes to the dataset in {directory}. Wait until it has closed the "
            "dataset, or open it for reading only."
        ) from None
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor
