"""What the dataset asks of the file system: whole writes, atomic replacement, the writers' locks.

No link is ever followed, and nothing but regular files is opened: a dataset may come from a
stranger.
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
TURN = "dataset.json.lock"
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers that say: nothing more can be stored here."""

_SAFELY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


@contextlib.contextmanager
def storing(what: str) -> Iterator[None]:
    """Turn the system's errors into a `DatasetError` that says what could not be stored."""
    try:
        yield
    except OSError as error:
        raise not_stored(what, error, "All rows committed before") from error


def not_stored(what: str, error: OSError, safe: str) -> DatasetError:
    """Return the error for something that could not be stored.

    Args:
        what: What it was.
        error: What the system says.
        safe: What is intact all the same.
    """
    full = error.errno in FULL
    reason = "the disk is full" if full else (error.strerror or str(error))
    advice = " Free some space and go on, or open the dataset again." if full else ""
    return DatasetError(f"{what} cannot be stored: {reason}. {safe} are intact.{advice}")


def open_regular(path: Path | str, flags: int = os.O_RDONLY) -> int:
    """Open a file and return its descriptor.

    Raises:
        OSError: It cannot be opened, or is a link, a folder, a pipe or a device.
    """
    try:
        descriptor = os.open(path, flags | _SAFELY, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):
            error.strerror = "it is a link or no regular file"
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is a link or no regular file", str(path))
    return descriptor


def create_new(path: Path) -> int:
    """Make an empty file, instead of whatever has its name, and return its descriptor."""
    path.unlink(missing_ok=True)
    return open_regular(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)


def content(path: Path, limit: int) -> bytes:
    """Return the bytes of a file.

    Raises:
        OSError: It cannot be read, or is larger than `limit` bytes.
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


def copied(origin: int, place: int, target: int, target_place: int, count: int) -> bool:
    """Have the system copy bytes from one open file to another; return whether it could.

    Where the file system knows how, as Btrfs and XFS do, the files share the bytes on the disk.

    Raises:
        OSError: The disk is full.
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


def raw(array: Array) -> memoryview:
    """Return the bytes of a contiguous array, without a copy."""
    return array.reshape(-1).view("u1").data


def temporary(path: Path) -> Path:
    """Return the name under which a file is written before it takes its place."""
    return path.with_name(path.name + ".tmp")


def replace(path: Path, content: bytes, *, sync: bool = True) -> None:
    """Write a file that is either the old or the new one, whole, whenever the process dies.

    Args:
        path: The file.
        content: What it holds then.
        sync: Whether to wait for the disk, so that this holds for a power cut too.
    """
    draft = temporary(path)
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
    """Bring the folder's names to the disk, so that a renamed file survives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def lock(directory: Path) -> int:
    """Take a dataset's lock for one writer alone; closing the descriptor releases it.

    Raises:
        DatasetLockedError: There is another writer.
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
    """Take a dataset's lock for one of several writers.

    Returns:
        The descriptor, whose closing releases the lock, and whether there is no other writer: the
        lock is then this one's alone, until `share` lets others in.

    Raises:
        DatasetLockedError: There is a writer that shares the dataset with nobody.
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
    """Let others share the lock.

    Raises:
        DatasetLockedError: A writer that shares with nobody was quicker.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _locked(directory, descriptor) from None


@contextlib.contextmanager
def turn(directory: Path) -> Iterator[None]:
    """Wait for one's turn to change the manifest, among writers that share a dataset."""
    descriptor = open_regular(directory / TURN, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _locked(directory: Path, descriptor: int) -> DatasetLockedError:
    owner = os.pread(descriptor, 20, 0).decode(errors="replace") or "unknown"
    return DatasetLockedError(
        f"Process {owner} writes to the dataset in {directory}. Wait until it has closed the "
        "dataset, or open it for reading only. For several writers at the same time, each opens "
        "it with writable=True, shared=True."
    )
