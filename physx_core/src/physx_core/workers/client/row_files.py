"""RowFiles: writes a client's rows to partitions in the dataset's folder."""

from __future__ import annotations

import contextlib
import socket
from collections import deque
from pathlib import Path
from typing import Any

from physx_core import files
from physx_core.dataset.store.manifest import Partition
from physx_core.dataset.write.partition_writer import PartitionWriter
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.values import decode, encode
from physx_core.typing import Batch
from physx_core.workers.client.link import RunEnded, WorkerLink

_LARGEST_PROOF = 1024


class RowFiles:
    """Writes rows to partitions that the server begins, and tells it where they are."""

    def __init__(self, link: WorkerLink, setup: dict[str, Any]) -> None:
        """Prove that this is the server's folder.

        Args:
            link: The connection to the server.
            setup: The folder, and where the proof is.

        Raises:
            DatasetError: If the folder cannot be read.
        """
        self._link = link
        self._directory = Path(setup["directory"])
        self._writer: PartitionWriter | None = None
        self._asked, self._fields = False, list[Field]()
        path = self._directory / setup["file"]
        try:
            proof = files.read_content(path, _LARGEST_PROOF)
        except OSError as error:
            raise DatasetError(
                f"This client, on {socket.gethostname()}, must write to {self._directory}, but "
                f"the file {path.name} that the run on {setup['host']} put there cannot be read "
                f"here: {error.strerror}. DatasetConfig.writers='clients' needs a folder that all "
                "machines share under the same path; otherwise use writers='server'."
            ) from error
        link.send(pack(Kind.FOLDER, proof))

    def put(self, rows: Batch, count: int, fields: list[Field]) -> None:
        """Write and commit a block of rows, and tell the server their address."""
        self._fields = fields
        while self._writer is None or self._writer.room < count:
            self._ask()
            self._wait()
        first = self._writer.append(rows, count)
        self._link.send(pack(Kind.WRITTEN, number=first))
        if self._writer.room < count and not self._asked:
            self._ask()  # ahead, for the next block

    def tell_sealed(self, *, wait: bool = False) -> None:
        """Tell the server which partitions have been sealed; it knows all of their rows."""
        for sealed in () if self._writer is None else self._writer.take_sealed(wait=wait):
            self._link.send(pack(Kind.SEALED, encode(sealed.checksums), sealed.index))

    def take(self, frame: Frame) -> None:
        """Take a partition that the server has begun."""
        plain = decode(frame.payload)
        if self._writer is None:
            self._writer = PartitionWriter(self._directory, self._fields, plain["capacity"])
        entry = Partition(plain["mode"], plain["session"], plain["index"], plain["first_row"])
        self._writer.add(entry)
        self._asked = False

    def close(self) -> None:
        """Close the files."""
        try:
            with contextlib.suppress(RunEnded):
                self.tell_sealed(wait=True)
        finally:
            if self._writer is not None:
                self._writer.close()

    def _ask(self) -> None:
        if not self._asked:
            self._link.send(pack(Kind.PARTITION))
        self._asked = True

    def _wait(self) -> None:
        """Wait for the partition that was asked for; put back other messages."""
        others: deque[Frame] = deque()
        while True:
            frame = self._link.receive()
            if frame.kind is Kind.CLOSE:
                raise RunEnded
            if frame.kind is Kind.PARTITION:
                self.take(frame)
                break
            others.append(frame)
        while others:
            self._link.put_back(others.pop())
