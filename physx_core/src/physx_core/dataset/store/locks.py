"""Locks for a dataset's writers: a single one, or several that take turns with the manifest."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

from physx_core import files
from physx_core.errors import DatasetLockedError

LOCK = "dataset.lock"
MANIFEST_LOCK = "dataset.json.lock"
_MOMENT = 2.0  # for a process that a killed writer was about to start
_PAUSE = 0.02


def lock(directory: Path, patience: float = _MOMENT) -> files.FileLock:
    """Acquire a dataset's lock for a single writer.

    A writer that was killed while starting a process may have left a forked copy of itself, which
    holds the lock until its exec.

    Args:
        directory: Folder of the dataset.
        patience: Time in s to wait if the process that holds the lock is no longer running.

    Raises:
        DatasetLockedError: If there is another writer.
    """
    lock = files.FileLock(directory / LOCK)
    until, looked = time.monotonic() + patience, False
    try:
        while not lock.acquire():
            if looked and (time.monotonic() > until or _owner_runs(lock)):
                raise _locked(directory, lock)
            looked = True  # the first time it may have been a reader that asks: see `is_written`
            time.sleep(_PAUSE)
        files.resize(lock.descriptor, 0)
        files.write_at(lock.descriptor, str(os.getpid()).encode(), 0)
    except BaseException:
        lock.close()
        raise
    return lock


def lock_shared(directory: Path) -> tuple[files.FileLock, bool]:
    """Acquire a dataset's lock for one of several writers.

    Returns:
        The lock, and whether there is no other writer: it is then exclusive until `share` admits
        others.

    Raises:
        DatasetLockedError: If an exclusive writer has the dataset open.
    """
    with contextlib.suppress(DatasetLockedError):
        return lock(directory, 0.0), True
    lock_of_several = files.FileLock(directory / LOCK)
    try:
        share(directory, lock_of_several)
    except BaseException:
        lock_of_several.close()
        raise
    return lock_of_several, False


def is_written(directory: Path) -> bool:
    """Return whether another process has locked a dataset as its only writer; changes nothing."""
    # There may be no file, or a file system without locks.
    with contextlib.suppress(OSError), files.opened(directory / LOCK) as descriptor:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return os.pread(descriptor, 20, 0) != str(os.getpid()).encode()
    return False


def share(directory: Path, lock: files.FileLock) -> None:
    """Share the lock with other writers.

    Raises:
        DatasetLockedError: If an exclusive writer acquired it first.
    """
    if not lock.acquire(shared=True):
        raise _locked(directory, lock)


@contextlib.contextmanager
def lock_manifest(directory: Path) -> Iterator[None]:
    """Hold the manifest's lock, which writers of a shared dataset take in turn."""
    with files.FileLock(directory / MANIFEST_LOCK) as lock:
        lock.acquire(wait=True)
        yield


def _owner(lock: files.FileLock) -> str:
    return os.pread(lock.descriptor, 20, 0).decode(errors="replace")


def _owner_runs(lock: files.FileLock) -> bool:
    try:
        os.kill(int(_owner(lock)), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except (PermissionError, ValueError):  # another user's process, or not written yet
        return True
    return True


def _locked(directory: Path, lock: files.FileLock) -> DatasetLockedError:
    owner = _owner(lock) or "unknown"
    return DatasetLockedError(
        f"Process {owner} is writing to the dataset in {directory}. Wait until it has closed the "
        "dataset, or open it for reading only. For several writers at the same time, open it "
        "with writable=True, shared=True in each."
    )
