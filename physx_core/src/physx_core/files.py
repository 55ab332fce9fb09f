"""File operations: all disk access of datasets and checkpoints goes through this module.

Each function does one thing completely or raises. Functions that wait for the disk state what
survives a power failure. Links are never followed, and only regular files are opened, because a
dataset may come from an untrusted source.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from physx_core.closeable import Closeable
from physx_core.errors import DatasetError, PhysxError
from physx_core.typing import Array

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers for a full disk, an exhausted quota, and the maximum file size."""

_BLOCK = 2**18
_SAFELY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


@contextlib.contextmanager
def storing(what: str) -> Iterator[None]:
    """Convert system errors to a `DatasetError` that names what could not be stored."""
    try:
        yield
    except OSError as error:
        raise storage_error(what, error, "All previously committed rows") from error


def storage_error(
    what: str,
    error: OSError,
    safe: str,
    kind: type[PhysxError] = DatasetError,
    advice: str = "continue, or open the dataset again",
) -> PhysxError:
    """Return the error for something that could not be stored.

    Args:
        what: What could not be stored.
        error: The system's error.
        safe: What is still intact.
        kind: Class of the returned error.
        advice: What to do after freeing some space, if the disk is full.
    """
    if isinstance(error, SyncError) and kind is DatasetError:
        return DatasetError(
            f"{what} cannot be stored: the disk has failed ({error.strerror}), and rows of the "
            "last few seconds may be lost. Close the dataset and open it again to get all intact "
            "rows."
        )
    if isinstance(error, RemovedError):
        return DatasetError(
            f"{what} cannot be stored: {error.filename} was removed while it was being written, "
            "and the rows in it are lost."
        )
    full = error.errno in FULL
    reason = "the disk is full" if full else (error.strerror or str(error))
    if isinstance(error, SyncError):
        reason = f"the disk has failed ({reason})"
    then = f" Free some space and {advice}." if full else ""
    return kind(f"{what} cannot be stored: {reason}. {safe} are intact.{then}")


def open_regular(path: Path | str, flags: int = os.O_RDONLY) -> int:
    """Open a file and return its descriptor.

    Raises:
        OSError: If it cannot be opened, or is a link, folder, pipe, or device.
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


@contextlib.contextmanager
def opened(path: Path, flags: int = os.O_RDONLY) -> Iterator[int]:
    """Open a file as `open_regular` does, and close it at the end of the block."""
    descriptor = open_regular(path, flags)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def create_new(path: Path) -> int:
    """Create an empty file, replacing an existing one, and return its descriptor."""
    remove(path)
    return open_regular(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)


def duplicate(descriptor: int) -> int:
    """Return another descriptor for an open file."""
    return os.dup(descriptor)


def close(descriptor: int) -> None:
    """Close a file."""
    os.close(descriptor)


def size(descriptor: int) -> int:
    """Return the size of an open file in bytes."""
    return os.fstat(descriptor).st_size


class FileLock(Closeable):
    """A lock on a file, created if needed, for the process that opens it.

    The end of that process releases it, too, however it ends. Processes forked meanwhile inherit
    the descriptor, but neither keep the lock when it is closed, nor release it themselves.

    Attributes:
        descriptor: Descriptor of the file, which may hold a few bytes for others to read.
    """

    def __init__(self, path: Path) -> None:
        """Open the file without locking it.

        Raises:
            OSError: If it cannot be opened.
        """
        self.descriptor = open_regular(path, os.O_RDWR | os.O_CREAT)
        self._owner = os.getpid()

    @property
    def is_own(self) -> bool:
        """Whether this process opened it, rather than having been forked from one that did."""
        return os.getpid() == self._owner

    def acquire(self, *, shared: bool = False, wait: bool = False) -> bool:
        """Lock the file, or change the kind of the lock; return whether it is locked.

        Args:
            shared: Whether others may hold it at the same time, all of them shared.
            wait: Whether to wait for others to release it.
        """
        kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        try:
            fcntl.flock(self.descriptor, kind | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Release it; calling it again does nothing."""
        descriptor, self.descriptor = self.descriptor, -1
        if descriptor < 0:
            return
        try:
            # An flock lasts until the last descriptor is closed, also those of forked processes.
            if self.is_own:
                fcntl.flock(descriptor, fcntl.LOCK_UN)
        finally:
            os.close(descriptor)


def try_lock(path: Path) -> FileLock | None:
    """Lock a file, creating it if needed; return None if it is already locked.

    Raises:
        OSError: If it cannot be opened or locked.
    """
    lock = FileLock(path)
    try:
        if lock.acquire():
            return lock
    except BaseException:
        lock.close()
        raise
    lock.close()
    return None


def is_removed(descriptor: int) -> bool:
    """Return whether an open file has been removed and no longer has a name."""
    return os.fstat(descriptor).st_nlink == 0


def names(folder: Path) -> list[str]:
    """Return the names of everything in a folder, sorted; none if there is no such folder."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        return sorted(os.listdir(folder))
    return []


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


def read_blocks(path: Path) -> Iterator[memoryview]:
    """Yield the contents of a file in blocks; each is valid until the next one.

    Raises:
        OSError: If it cannot be read.
    """
    with opened(path) as descriptor:
        buffer = memoryview(bytearray(_BLOCK))
        while count := os.readv(descriptor, [buffer]):
            yield buffer[:count]


def read_head(descriptor: int, limit: int) -> bytes:
    """Return at most the first `limit` bytes of an open file."""
    return os.pread(descriptor, limit, 0)


def read_tail(path: Path, limit: int) -> bytes:
    """Return at most the last `limit` bytes of a file.

    Raises:
        OSError: If it cannot be read.
    """
    with os.fdopen(open_regular(path), "rb") as file:
        file.seek(-min(limit, size(file.fileno())), os.SEEK_END)
        return file.read(limit)


def write_at(descriptor: int, content: bytes | memoryview, offset: int) -> None:
    """Write the whole content at an offset of an open file."""
    write_pieces(descriptor, ((content, offset),))


def write_pieces(descriptor: int, pieces: Iterable[tuple[bytes | memoryview, int]]) -> None:
    """Write several contents at their offsets of an open file, one after another."""
    for content, offset in pieces:
        written, nbytes = os.pwrite(descriptor, content, offset), memoryview(content).nbytes
        if written < nbytes:  # the system writes at most 2 GB at once, and less to a full disk
            view = np.frombuffer(content, "u1").data
            while written < nbytes:
                written += os.pwrite(descriptor, view[written:], offset + written)


def read_at(descriptor: int, view: memoryview, offset: int) -> bool:
    """Fill a buffer from an offset of an open file; return whether the file reached that far."""
    while view:
        count = os.preadv(descriptor, [view], offset)
        if not count:
            return False
        view, offset = view[count:], offset + count
    return True


def copy_range(origin: int, place: int, target: int, target_place: int, count: int) -> bool:
    """Have the system copy bytes from one open file to another; return whether it could.

    On file systems such as Btrfs and XFS, the files then share the bytes on the disk.

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
    """Return a contiguous array's memory as bytes."""
    return array.reshape(-1).view("u1").data


def resize(descriptor: int, size: int) -> None:
    """Set the size of an open file; added bytes read as zeros and take no space yet."""
    os.ftruncate(descriptor, size)


def reserve(descriptor: int, start: int, stop: int) -> None:
    """Allocate disk space for a range of an open file, so that writing to it cannot run out."""
    os.posix_fallocate(descriptor, start, stop - start)


class SyncError(OSError):
    """A sync has failed: which of the earlier writes are on the disk is unknown.

    A later sync may still succeed, because the system has dropped what it could not write.
    """


class RemovedError(OSError):
    """A file was removed while it was being written."""


def sync(descriptor: int) -> None:
    """Wait until the content of an open file is on the disk.

    Raises:
        SyncError: If the disk fails.
    """
    try:
        os.fdatasync(descriptor)
    except OSError as error:
        raise SyncError(error.errno, error.strerror) from error


def start_sync(path: Path) -> None:
    """Start writing the content of a file to the disk, without waiting for it."""
    with opened(path) as descriptor:
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)


def sync_file(path: Path) -> None:
    """Wait until the content of a file is on the disk.

    Raises:
        SyncError: If the disk fails.
        OSError: If there is no such file.
    """
    with opened(path) as descriptor:
        sync(descriptor)


def sync_folder(folder: Path) -> None:
    """Wait until a folder's entries are on the disk: new, renamed, and removed files.

    Raises:
        SyncError: If the disk fails.
        OSError: If there is no such folder.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        raise SyncError(error.errno, error.strerror) from error
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Create a folder and its missing parents durably: they survive a power failure."""
    missing = []
    while not folder.is_dir():
        missing.append(folder)
        folder = folder.parent
    for made in reversed(missing):
        with contextlib.suppress(FileExistsError):  # another process was faster
            os.mkdir(made)
        sync_folder(made.parent)


def create_folder(folder: Path, *, sync: bool = True) -> None:
    """Create a folder in an existing one.

    Args:
        folder: The folder.
        sync: Whether to wait for the disk, so that the folder survives a power failure.

    Raises:
        FileExistsError: If something of that name exists.
    """
    os.mkdir(folder)
    if sync:
        sync_folder(folder.parent)


def rename(path: Path, target: Path) -> None:
    """Rename a file or folder; an existing file of the new name is replaced."""
    os.replace(path, target)


def link(path: Path, target: Path) -> None:
    """Create a hard link to a file, or copy the file if that is not possible."""
    try:
        os.link(path, target)
    except OSError:
        replace(target, path.read_bytes())


def remove(path: Path) -> None:
    """Remove a file, if it exists."""
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)


def remove_folder(folder: Path) -> None:
    """Remove a folder with everything in it, if it exists."""
    for root, folders, names in os.walk(folder, topdown=False):
        for name in names:
            os.unlink(os.path.join(root, name))
        for name in folders:
            path = os.path.join(root, name)
            (os.unlink if os.path.islink(path) else os.rmdir)(path)
    with contextlib.suppress(FileNotFoundError):
        os.rmdir(folder)


def temporary_path(path: Path) -> Path:
    """Return the path that a file is written to before it is renamed to `path`."""
    return path.with_name(path.name + ".tmp")


def replace(path: Path, content: bytes, *, wait: bool = True) -> None:
    """Replace a file atomically: if the process dies, either the old or the new file exists.

    Args:
        path: The file.
        content: Its new content.
        wait: Whether to wait for the disk, so that this also holds after a power failure.
    """
    draft = temporary_path(path)
    try:
        descriptor = create_new(draft)
        try:
            write_at(descriptor, content, 0)
            if wait:
                sync(descriptor)
        finally:
            os.close(descriptor)
        rename(draft, path)
    except OSError:
        with contextlib.suppress(OSError):
            remove(draft)
        raise
    if wait:
        sync_folder(path.parent)
