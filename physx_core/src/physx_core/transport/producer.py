"""Producer: makes rows within the credit that the server grants, and sends them in blocks."""

from __future__ import annotations

import time

import numpy as np

from physx_core.columns import ROW_FIELDS, Columns, shaped_by
from physx_core.errors import ConnectionRefusedByPeerError, NotFiniteError, PhysxError
from physx_core.instance import Instance
from physx_core.transport.frames import Frame, Kind, pack
from physx_core.transport.link import Link, RunEnded
from physx_core.transport.rows import pack_rows, row_bytes
from physx_core.transport.values import decode, encode

_BLOCK_BYTES = 1 << 16
_BLOCK_ROWS = 4096
_BLOCK_TIME = 5e-3


class Producer:
    """Steps one instance.

    Attributes:
        made: How many rows were made, and so the number of the row in the making, counted from 0.
        failure: Why rows that were made cannot be sent.
    """

    def __init__(self, link: Link, instance: Instance) -> None:
        """Keep what rows are made with.

        Args:
            link: Where they go.
            instance: What makes them; open.
        """
        self.made = 0
        self.failure: PhysxError | None = None
        self._link, self._instance = link, instance
        self._columns: Columns | None = None
        self._credit = 0
        self._filled = 0
        self._sent_at = 0.0

    def run(self) -> None:
        """Make rows until the server ends the run.

        Raises:
            RunEnded: The server ended the run or is gone, or there is a `failure`.
            PhysxError: A row could not be made; all rows before it were sent.
        """
        while True:
            if self.made >= self._credit:
                while self.made >= self._credit:
                    self._obey(self._link.receive())
                self._sent_at = time.monotonic()
            try:
                self._make_row()
            except PhysxError:
                self.flush()
                raise
            if self._is_due():
                self.flush()
                while self._link.has_message():
                    self._obey(self._link.receive())

    def flush(self) -> None:
        """Send the rows that were not sent yet.

        Rows up to one that holds NaN or an infinite number are sent, and `failure` names that one.

        Raises:
            RunEnded: There is a `failure`, or the server is gone. No environment can catch it.
        """
        columns, count = self._columns, self._filled
        self.made -= count
        while columns is not None and count:
            try:
                block = columns.rows(count)
            except NotFiniteError as error:
                # The named row is the first of one field; another field may have an earlier one.
                self.failure = error
                count = int(np.argmax(columns.arrays["step"][:count] == error.step))
            else:
                self._link.send(pack_rows(block, count))
                break
        self.made += count
        self._filled = 0
        self._sent_at = time.monotonic()
        if self.failure is not None:
            raise RunEnded

    def _make_row(self) -> None:
        instance = self._instance
        sample = instance.step()
        columns = self._columns
        if columns is None:
            fields = shaped_by(instance.fields, sample)
            size = max(1, row_bytes([*fields, *ROW_FIELDS]))
            capacity = min(max(1, _BLOCK_BYTES // size), _BLOCK_ROWS)
            columns = self._columns = Columns(fields, capacity)
        columns.put(
            self._filled, sample, instance.instance_id, instance.last_episode, instance.last_step
        )
        if not self.made:
            table = [field.to_dict() for field in columns.fields]
            self._link.send(pack(Kind.FIELDS, encode(table)))
        self._filled += 1
        self.made += 1

    def _is_due(self) -> bool:
        columns = self._columns
        return (
            self.made >= self._credit
            or (columns is not None and self._filled == columns.capacity)
            or time.monotonic() - self._sent_at >= _BLOCK_TIME
        )

    def _obey(self, frame: Frame) -> None:
        if frame.kind is Kind.CREDIT:
            self._credit = frame.number
        elif frame.kind is Kind.APPLY:
            prediction = decode(frame.payload)
            for row in range(frame.number):
                self._instance.apply({name: values[row] for name, values in prediction.items()})
        elif frame.kind is Kind.CLOSE:
            raise RunEnded
        elif frame.kind not in (Kind.ANSWER, Kind.REFUSAL):  # those of an abandoned request
            raise ConnectionRefusedByPeerError(
                f"The server sent {frame.kind.name}, which only a client sends."
            )
