"""Locks for a dataset's writers: a single one, or several that take turns with the manifest."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

from physx_core import files
from physx_core.errors import DatasetError, DatasetLockedError

LOCK = "dataset.lock"
MANIFEST_LOCK = "dataset.json.lock"
_PATIENCE = 20.0
_MOMENT = 2.0  # for a process that a killed writer was about to start
_PAUSE = 0.02


def lock(directory: Path, patience: float = _MOMENT) -> int:
    """Acquire a dataset's lock for a single writer; closing the descriptor releases it.

    A writer that was killed while starting a process may have left a forked copy of itself, which
    holds the lock until its exec.

    Args:
        directory: Folder of the dataset.
        patience: Time in s to wait if the process that holds the lock is no longer running.

    Raises:
        DatasetLockedError: If there is another writer.
    """
    descriptor = files.open_regular(directory / LOCK, os.O_RDWR | os.O_CREAT)
    until = time.monotonic() + patience
    try:
        while not _try_lock(descriptor):
            if time.monotonic() > until or _owner_runs(descriptor):
                raise _locked(directory, descriptor)
            time.sleep(_PAUSE)
        files.resize(descriptor, 0)
        files.write_at(descriptor, str(os.getpid()).encode(), 0)
    except BaseException:
        files.close(descriptor)
        raise
    return descriptor


def lock_shared(directory: Path) -> tuple[int, bool]:
    """Acquire a dataset's lock for one of several writers.

    Returns:
        The descriptor (closing it releases the lock), and whether there is no other writer: the
        lock is then exclusive until `share` admits others.

    Raises:
        DatasetLockedError: If an exclusive writer has the dataset open.
    """
    with contextlib.suppress(DatasetLockedError):
        return lock(directory, 0.0), True
    descriptor = files.open_regular(directory / LOCK, os.O_RDWR | os.O_CREAT)
    try:
        share(directory, descriptor)
    except BaseException:
        files.close(descriptor)
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


def take_over(path: Path, place: int) -> int:
    """Lock one byte of a file for the process that writes a stripe; closing it releases the lock.

    The previous process of this place may need a moment to exit. As the system releases its lock on
    exit, the two never write at the same time.

    Returns:
        The descriptor.

    Raises:
        DatasetError: If another process keeps the lock.
    """
    descriptor = files.open_regular(path, os.O_RDWR)
    until = time.monotonic() + _PATIENCE
    try:
        while True:
            try:
                fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
            except (BlockingIOError, PermissionError):
                if time.monotonic() > until:
                    raise DatasetError(
                        f"An earlier client is still writing the rows of instance {place + 1} to "
                        f"{path.parent}, {_PATIENCE:g} s after another one took its place. "
                        "Terminate it; its machine may have lost its connection to the run."
                    ) from None
                time.sleep(_PAUSE)
            else:
                return descriptor
    except BaseException:
        files.close(descriptor)
        raise


@contextlib.contextmanager
def lock_manifest(directory: Path) -> Iterator[None]:
    """Hold the manifest's lock, which writers of a shared dataset take in turn."""
    descriptor = files.open_regular(directory / MANIFEST_LOCK, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        files.close(descriptor)


def _try_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _owner(descriptor: int) -> str:
    return os.pread(descriptor, 20, 0).decode(errors="replace")


def _owner_runs(descriptor: int) -> bool:
    try:
        os.kill(int(_owner(descriptor)), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except (PermissionError, ValueError):  # another user's process, or not written yet
        return True
    return True


def _locked(directory: Path, descriptor: int) -> DatasetLockedError:
    owner = _owner(descriptor) or "unknown"
    return DatasetLockedError(
        f"Process {owner} is writing to the dataset in {directory}. Wait until it has closed the "
        "dataset, or open it for reading only. For several writers at the same time, open it "
        "with writable=True, shared=True in each."
    )
