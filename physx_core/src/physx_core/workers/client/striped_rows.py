"""StripedRows: the row sink of clients that write their rows to partitions."""

from __future__ import annotations

import socket
from collections import deque
from pathlib import Path
from typing import Any

from physx_core import files
from physx_core.dataset.store import locks
from physx_core.dataset.store.manifest import Partition, has_statistics
from physx_core.dataset.store.partition.format import Stripe
from physx_core.dataset.write.stripe_writer import StripeWriter
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.values import decode, encode
from physx_core.typing import Batch
from physx_core.workers.client.link import RunEnded, WorkerLink

_LARGEST_PROOF = 1024


class StripedRows:
    """Writes the rows to partitions in the dataset's folder, and tells the server how many.

    Attributes:
        ended: Whether the server wants no more rows.
    """

    def __init__(self, link: WorkerLink, setup: dict[str, Any]) -> None:
        """Store what the server sent.

        Args:
            link: The connection to the server.
            setup: The folder, and the partitions that already exist.
        """
        self._link, self._setup = link, setup
        self._directory = Path(setup["directory"])
        self._told, self._lock = 0, -1
        self._writer: StripeWriter | None = None
        self.ended = False

    def open(self, rows: int) -> int:
        """Prove that this is the server's folder, and continue the partitions in it.

        Raises:
            DatasetError: If the folder is missing or a different one, or another process
                writes the same rows.
        """
        path = self._directory / self._setup["file"]
        self._prove(path)
        with files.storing(f"The rows of this client in {self._directory}"):
            self._lock = locks.take_over(path, self._setup["place"])
        self._told = rows
        for number, plain in self._setup["partitions"]:
            self._add(number, plain)
        return rows if self._writer is None else self._writer.resume(rows)

    def put(self, rows: Batch, count: int, fields: list[Field]) -> None:
        """Write and commit a block of rows."""
        done = 0
        while done < count:
            writer = self._writer
            if writer is None or not writer.room or set(writer.fields) != set(fields):
                self._wait()  # for a partition, or the end if other instances have other fields
                continue
            part = min(count - done, writer.room)
            try:
                writer.append({name: rows[name][done : done + part] for name in rows}, part)
            finally:
                self.tell()
            done += part
            self._send_sealed(writer, writer.take_sealed())

    def tell(self) -> None:
        """Tell the server how many rows there are, if it does not know yet."""
        if self._writer is not None and self._writer.rows > self._told:
            self._told = self._writer.rows
            self._link.send(pack(Kind.WRITTEN, number=self._told))

    def take(self, frame: Frame) -> bool:
        """Handle a message about partitions; return whether it was one."""
        if frame.kind is Kind.PARTITION:
            self._add(frame.number, decode(frame.payload))
        elif frame.kind is Kind.SEAL:
            self.ended = True
            if self._writer is not None:
                self._send_sealed(self._writer, self._writer.finish(frame.number))
        return frame.kind in (Kind.PARTITION, Kind.SEAL)

    def close(self) -> None:
        """Close the files; from then on another client may write the rows."""
        try:
            if self._writer is not None:
                self._writer.close()
        finally:
            if self._lock >= 0:
                files.close(self._lock)
                self._lock = -1

    def _prove(self, path: Path) -> None:
        try:
            proof = files.read_content(path, _LARGEST_PROOF)
        except OSError as error:
            raise DatasetError(
                f"This client, on {socket.gethostname()}, must write to {self._directory}, but "
                f"the file {path.name} that the run on {self._setup['host']} put there cannot "
                f"be read here: {error.strerror}. DatasetConfig.writers='clients' needs a folder "
                "that all machines share under the same path; otherwise use writers='server'."
            ) from error
        self._link.send(pack(Kind.FOLDER, proof))

    def _add(self, number: int, plain: dict[str, Any]) -> None:
        if self._writer is None:
            fields = [Field.from_dict(one) for one in plain["fields"]]
            self._writer = StripeWriter(self._directory, fields, plain["capacity"])
            self._writer.rows = self._told
        stripe = plain["stripe"]
        entry = Partition(
            plain["mode"],
            plain["session"],
            plain["index"],
            plain["first_row"],
            stripe=stripe and Stripe(*stripe),
        )
        self._writer.add(number, entry)

    def _wait(self) -> None:
        """Wait for the server's next message about partitions; put back the others."""
        others: deque[Frame] = deque()
        while True:
            frame = self._link.receive()
            if frame.kind is Kind.CLOSE:
                raise RunEnded
            if self.take(frame):
                break
            others.append(frame)
        while others:
            self._link.put_back(others.pop())
        if self.ended:
            raise RunEnded

    def _send_sealed(self, writer: StripeWriter, sealed: list[tuple[int, Partition]]) -> None:
        for number, partition in sealed:
            if number * writer.capacity + partition.rows > self._told:
                continue  # the server does not know of all these rows yet, and seals it
            plain = {
                "rows": partition.rows,
                "checksums": partition.checksums,
                "statistics": {
                    field.name: partition.running[field.name].arrays()
                    for field in writer.fields
                    if has_statistics(field)
                },
            }
            self._link.send(pack(Kind.SEALED, encode(plain, "a sealed partition"), number))
