"""Row sinks: where a client's rows go; here over the connection."""

from __future__ import annotations

from typing import Protocol

from physx_core.fields import Field
from physx_core.net.frames import Frame
from physx_core.typing import Batch
from physx_core.workers.client.link import WorkerLink
from physx_core.workers.row_codec import pack_rows


class RowSink(Protocol):
    """Takes the rows that a client makes.

    Attributes:
        ended: Whether no more rows are to be made.
    """

    ended: bool

    def open(self, rows: int) -> int:
        """Begin; return how many of the `rows` rows that the server has need not be put again."""

    def put(self, rows: Batch, count: int, fields: list[Field]) -> None:
        """Take a block of rows, in their order."""

    def tell(self) -> None:
        """Tell the server of rows that it does not know of, if there are any."""

    def take(self, frame: Frame) -> bool:
        """Handle a message that is meant for it; return whether it was."""

    def close(self) -> None:
        """Release all resources."""


class SentRows:
    """Sends the rows to the server."""

    ended = False

    def __init__(self, link: WorkerLink) -> None:
        self._link = link

    def open(self, rows: int) -> int:
        """Return `rows`: what was sent once is there."""
        return rows

    def put(self, rows: Batch, count: int, fields: list[Field]) -> None:
        """Send a block of rows."""
        self._link.send_parts(pack_rows(rows, count))

    def tell(self) -> None:
        """Do nothing: the server has all rows."""

    def take(self, frame: Frame) -> bool:
        """No message is meant for it."""
        return False

    def close(self) -> None:
        """Do nothing."""
