"""Row sinks: where a client's rows go. The one here sends them to the server."""

from __future__ import annotations

from typing import Protocol

from physx_core.fields import Field
from physx_core.net.frames import Frame
from physx_core.typing import Batch
from physx_core.workers.client.link import WorkerLink
from physx_core.workers.row_codec import pack_rows


class RowSink(Protocol):
    """Takes the rows that a client generates.

    Attributes:
        ended: Whether no more rows are needed.
    """

    ended: bool

    def open(self, rows: int) -> int:
        """Open; return how many of the server's `rows` rows do not have to be put again."""

    def put(self, rows: Batch, count: int, fields: list[Field]) -> None:
        """Take a block of rows, in order."""

    def tell(self) -> None:
        """Tell the server about rows that it does not know of, if any."""

    def take(self, frame: Frame) -> bool:
        """Handle a message if it is meant for the sink; return whether it was."""

    def close(self) -> None:
        """Release all resources."""


class SentRows:
    """Sends the rows to the server."""

    ended = False

    def __init__(self, link: WorkerLink) -> None:
        self._link = link

    def open(self, rows: int) -> int:
        """Return `rows`: the server has everything that was sent."""
        return rows

    def put(self, rows: Batch, count: int, fields: list[Field]) -> None:
        """Send a block of rows."""
        self._link.send_parts(pack_rows(rows, count))

    def tell(self) -> None:
        """Do nothing: the server has all rows."""

    def take(self, frame: Frame) -> bool:
        """Return False: no message is meant for this sink."""
        return False

    def close(self) -> None:
        """Do nothing."""
