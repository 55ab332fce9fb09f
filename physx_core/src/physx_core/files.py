"""File operations of datasets: complete writes, atomic replacement, and the writers' locks.

No link is ever followed, and only regular files are opened: a dataset may come from an untrusted
source.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from physx_core.errors import DatasetError, DatasetLockedError
from physx_core.typing import Array

LOCK = "dataset.lock"
MANIFEST_LOCK = "dataset.json.lock"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers of a disk that is full, a quota or a file size that is reached."""

_SAFELY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


@contextlib.contextmanager
def storing(what: str) -> Iterator[None]:
    """Translate the system's errors into a `DatasetError` that says what could not be stored."""
    try:
        yield
    except OSError as error:
        raise storage_error(what, error, "All rows committed before") from error


def storage_error(what: str, error: OSError, safe: str) -> DatasetError:
    """Return the error for something that could not be stored.

    Args:
        what: What was to be stored.
        error: The system's error.
        safe: What is intact nevertheless.
    """
    full = error.errno in FULL
    reason = "the disk is full" if full else (error.strerror or str(error))
    advice = " Free some space and continue, or open the dataset again." if full else ""
    return DatasetError(f"{what} cannot be stored: {reason}. {safe} are intact.{advice}")


def open_regular(path: Path | str, flags: int = os.O_RDONLY) -> int:
    """Open a file and return its descriptor.

    Raises:
        OSError: If it cannot be opened, or is a link, a folder, a pipe or a device.
    """
    try:
        descriptor = os.open(path, flags | _SAFELY, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):
            error.strerror = "it is not a regular file"
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return descriptor


def create_new(path: Path) -> int:
    """Create an empty file, replacing any of that name, and return its descriptor."""
    path.unlink(missing_ok=True)
    return open_regular(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)


def read_content(path: Path, limit: int) -> bytes:
    """Return the bytes of a file.

    Raises:
        OSError: If it cannot be read, or is larger than `limit` bytes.
    """
    with os.fdopen(open_regular(path), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise OSError(errno.EFBIG, f"it has {size} bytes, more than {limit}", str(path))
        return file.read(size)


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


def copy_range(origin: int, place: int, target: int, target_place: int, count: int) -> bool:
    """Let the system copy bytes from one open file to another; return whether it could.

    File systems such as Btrfs and XFS let the files share the bytes on the disk.

    Raises:
        OSError: If the disk is full.
    """
    done = 0
    try:
        while done < count:
            step = os.copy_file_range(
                origin, target, count - done, place + done, target_place + done
            )
            if not step:
                return False
            done += step
    except OSError as error:
        if error.errno in FULL:
            raise
        return False
    return True


def as_bytes(array: Array) -> memoryview:
    """Return the memory of a contiguous array as bytes."""
    return array.reshape(-1).view("u1").data


def temporary_path(path: Path) -> Path:
    """Return the path that a file is written to before it replaces `path`."""
    return path.with_name(path.name + ".tmp")


def replace(path: Path, content: bytes, *, sync: bool = True) -> None:
    """Replace a file atomically: if the process dies, either the old or the new one is there.

    Args:
        path: The file.
        content: Its new content.
        sync: Whether to wait for the disk, so that this holds after a power cut, too.
    """
    draft = temporary_path(path)
    try:
        descriptor = create_new(draft)
        try:
            write_at(descriptor, content, 0)
            if sync:
                os.fsync(descriptor)
        finally:
            os.close(descriptor)
        draft.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            draft.unlink(missing_ok=True)
        raise
    if sync:
        sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk, so that a renamed file survives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def lock(directory: Path) -> int:
    """Acquire a dataset's lock for a single writer; closing the descriptor releases it.

    Raises:
        DatasetLockedError: If there is another writer.
    """
    descriptor = open_regular(directory / LOCK, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.ftruncate(descriptor, 0)
        write_at(descriptor, str(os.getpid()).encode(), 0)
    except BlockingIOError:
        error = _locked(directory, descriptor)
        os.close(descriptor)
        raise error from None
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def lock_shared(directory: Path) -> tuple[int, bool]:
    """Acquire a dataset's lock for one of several writers.

    Returns:
        The descriptor, whose closing releases the lock, and whether there is no other writer: the
        lock is then exclusive until `share` admits others.

    Raises:
        DatasetLockedError: If an exclusive writer has the dataset open.
    """
    with contextlib.suppress(DatasetLockedError):
        return lock(directory), True
    descriptor = open_regular(directory / LOCK, os.O_RDWR | os.O_CREAT)
    try:
        share(directory, descriptor)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor, False


def share(directory: Path, descriptor: int) -> None:
    """Share the lock with other writers.

    Raises:
        DatasetLockedError: If an exclusive writer acquired it first.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _locked(directory, descriptor) from None


@contextlib.contextmanager
def lock_manifest(directory: Path) -> Iterator[None]:
    """Hold the manifest's lock, which writers that share a dataset take in turn."""
    descriptor = open_regular(directory / MANIFEST_LOCK, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _locked(directory: Path, descriptor: int) -> DatasetLockedError:
    owner = os.pread(descriptor, 20, 0).decode(errors="replace") or "unknown"
    return DatasetLockedError(
        f"Process {owner} is writing to the dataset in {directory}. Wait until it has closed the "
        "dataset, or open it for reading only. For several writers at the same time, open it "
        "with writable=True, shared=True in each."
    )
