"""Drawn rows: a session file that records the rows of each batch that a buffer drew.

``stats/drawn_rows.bin`` consists of 8-byte little-endian integers: a magic number, the batch size,
then a record for each batch: the rows' indices in the dataset, and a CRC-32 of these and the batch
number. Records are only appended; reading stops at an incomplete or damaged one.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.errors import SessionError
from physx_core.session import Session
from physx_core.typing import Index

_NUMBER = np.dtype("<i8")
_MARK = int.from_bytes(b"physxrow", "little")
_HEAD = 2
_LARGEST = 2**40


class DrawnRows:
    """Writes the file, starting at a given batch; existing records from there on are dropped."""

    def __init__(self, session: Session, batch_size: int, first: int = 0) -> None:
        """Open the file.

        Args:
            session: The training's session.
            batch_size: Number of rows in a batch.
            first: Number of the first batch to write.

        Raises:
            DatasetError: If the file cannot be written.
        """
        self._path, self._number = _path(session.path), first
        self._nbytes = (batch_size + 1) * _NUMBER.itemsize
        head = np.array([_MARK, batch_size], _NUMBER)
        with files.storing(f"{self._path}"):
            files.make_folder(self._path.parent)
            if self._path.exists():
                self._descriptor = files.open_regular(self._path, os.O_RDWR)
            else:
                self._descriptor = files.create_new(self._path)
            try:
                files.write_at(self._descriptor, files.as_bytes(head), 0)
                files.resize(self._descriptor, head.nbytes + first * self._nbytes)
            except BaseException:
                self.close()
                raise

    def append(self, rows: Index) -> None:
        """Write the next batch.

        Args:
            rows: Indices of its rows in the dataset.

        Raises:
            DatasetError: If it cannot be written.
        """
        record = np.empty(len(rows) + 1, _NUMBER)
        record[:-1] = rows
        record[-1] = _checksum(self._number, record[:-1])
        place = _HEAD * _NUMBER.itemsize + self._number * self._nbytes
        with files.storing(f"{self._path}"):
            files.write_at(self._descriptor, files.as_bytes(record), place)
        self._number += 1

    def sync(self) -> None:
        """Wait until the file is on the disk.

        Raises:
            DatasetError: If the disk fails.
        """
        with files.storing(f"{self._path}"):
            files.sync(self._descriptor)

    def close(self) -> None:
        """Close the file."""
        files.close(self._descriptor)


def read_drawn_rows(session_dir: str | Path, batches: int | None = None) -> Index:
    """Return the rows in each batch of a training while environments generated them.

    Batches are numbered over all epochs in which rows were generated. Those of the buffer
    ``physx/stream`` are not recorded: batch n starts at row n times the batch size.

    Args:
        session_dir: The training's session.
        batches: Maximum number of batches to read; None: all.

    Returns:
        The rows' indices in the dataset, shape (batches, batch size).

    Raises:
        SessionError: If the session has no such file.
    """
    path = _path(Path(session_dir))
    try:
        content = files.read_content(path, _LARGEST)
    except OSError as error:
        raise SessionError(
            f"{path} cannot be read: {error.strerror or error}. It is only written by a training "
            "whose buffer keeps rows and draws batches from them (Training.online)."
        ) from error
    numbers = np.frombuffer(content, _NUMBER, len(content) // _NUMBER.itemsize)
    if len(numbers) < _HEAD or numbers[0] != _MARK or not 0 < numbers[1] < _LARGEST:
        raise SessionError(f"{path} is damaged, or was not written by physx.")
    width = int(numbers[1]) + 1
    records = numbers[_HEAD : _HEAD + (len(numbers) - _HEAD) // width * width].reshape(-1, width)
    count = 0
    for record in records[:batches]:
        if record[-1] != _checksum(count, record[:-1]):
            break
        count += 1
    return records[:count, :-1].astype(np.intp)


def _checksum(number: int, rows: Index) -> int:
    return crc32(np.ascontiguousarray(rows).data, number & 0xFFFFFFFF)


def _path(session_dir: Path) -> Path:
    return session_dir / "stats" / "drawn_rows.bin"
