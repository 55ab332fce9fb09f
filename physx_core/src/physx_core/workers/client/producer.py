"""Producer: generates rows within the server's credit, and sends them in blocks."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from physx_core.errors import (
    NotFiniteError,
    PhysxError,
    StateError,
)
from physx_core.net.frames import Frame, Kind, pack
from physx_core.net.remote_errors import encode_error
from physx_core.net.values import decode, encode
from physx_core.rows import ROW_FIELDS, RowBuffer, copy_row, infer_shapes
from physx_core.typing import Sample
from physx_core.workers.client.link import RunEnded, WorkerLink
from physx_core.workers.instance import Instance
from physx_core.workers.row_codec import pack_rows

_BLOCK_TIME = 20e-3


class Producer:
    """Steps one instance and sends its rows.

    Attributes:
        made: Number of generated rows, which is also the index of the next one.
        failure: Why generated rows cannot be sent; None while they can.
        shown: Number of messages with drawing events.
    """

    def __init__(
        self,
        link: WorkerLink,
        instance: Instance,
        *,
        rows: int = 0,
        rejected: int = 0,
        state_every: int = 0,
    ) -> None:
        """Store what generates and sends the rows.

        Args:
            link: The connection to the server.
            instance: Generates the rows; open.
            rows: How many rows the server has from earlier clients. They are generated again, but
                not sent.
            rejected: How many rejected rows the server has from earlier clients.
            state_every: Number of rows after which to send a state; 0: never.
        """
        self.made = self.shown = 0
        self.failure: PhysxError | None = None
        self._link, self._instance = link, instance
        self._clock = link.clock
        self._skip, self._skip_rejected = rows, rejected
        self._state_every, self._last_state, self._has_refused = state_every, 0, False
        self._orders = self._rejected = 0  # how many there have been
        self._buffer: RowBuffer | None = None
        self._announced = False
        self._stored: deque[Sample] = deque()
        self._credit = 0
        self._sent_at = 0.0

    def resume(self, state: Mapping[str, Any]) -> None:
        """Go on from the state that an earlier client sent.

        Args:
            state: Its counters, and what `_send_state` has sent. The counters ``shown`` and
                ``requests`` are None if that was in an earlier run.

        Raises:
            StateError: If the environment was created differently.
        """
        kept = decode(state["state"])
        self._instance.set_state(kept["instance"])
        self._stored.extend(kept["stored"])
        self.made = self._last_state = state["rows"]
        self._orders, self._rejected = state["orders"], state["rejected"]
        if state["requests"] is not None:  # the server counts on, as it has not been replaced
            self.shown, self._link.requests = state["shown"], state["requests"]

    def run(self) -> None:
        """Generate rows until the server ends the run."""
        while True:
            if self.made >= self._credit:
                while self.made >= self._credit:
                    self._obey(self._link.receive())
                self._sent_at = self._clock.monotonic()
            if self._state_every and self.made % self._state_every == 0:
                self._send_state()
            try:
                self._make_row()
            except PhysxError:
                self.flush()
                self._send_last_rejected()
                raise
            if self._is_due():
                self.flush()
                if self.made < self._skip:
                    self._link.send(pack(Kind.PING))
                self._listen()

    def flush(self) -> None:
        """Send the rows that have not been sent yet.

        If one contains NaN or infinity, only those before it are sent, and `failure` names it.
        """
        self._send_rejected()
        buffer = self._buffer
        if buffer is not None and buffer.count:
            self.made -= buffer.count
            try:
                rows = buffer.take()
            except NotFiniteError as error:
                self.failure, rows = error, buffer.take()
            count = len(rows["step"])
            if count:
                self._link.send_parts(pack_rows(rows, count))
            self.made += count
        self._sent_at = self._clock.monotonic()
        if self.failure is not None:
            raise RunEnded

    def announce_early(self) -> None:
        """Send the fields of the rows before the first row is complete, if all shapes are known."""
        fields, steps = self._instance.fields, self._credit > 0
        if steps and self._buffer is None and all(field.shape is not None for field in fields):
            self._buffer = RowBuffer(fields)
            self._announce(self._buffer)

    def _make_row(self) -> None:
        instance = self._instance
        sample = instance.step(self._stored.popleft() if self._stored else None)
        buffer = self._buffer
        if buffer is None:
            buffer = self._buffer = RowBuffer(infer_shapes(instance.fields, sample))
        is_repeated = self.made < self._skip  # and fails again if it is invalid
        numbers = (instance.instance_id, instance.last_episode, instance.last_step)
        buffer.put(sample, *numbers, finite=is_repeated)
        if is_repeated:
            buffer.clear()
        self._announce(buffer)
        self.made += 1

    def _send_state(self) -> None:
        """Send the state before the next row, and the rows before it.

        It is always taken after the same rows, as the next ones may depend on that: see
        `Instance.get_state`.
        """
        if self.made == self._last_state:
            return
        self.flush()
        self._last_state = self.made
        try:
            state = self._instance.get_state()
        except StateError as error:
            if not self._has_refused:
                self._link.send(pack(Kind.STATE, encode_error(error)))
            self._has_refused = True
            return
        counts = {"orders": self._orders, "shown": self.shown, "rejected": self._rejected}
        kept = encode({"instance": state, "stored": list(self._stored)}, "the state")
        self._link.send(pack(Kind.STATE, encode({**counts, "state": kept}), self.made))

    def _announce(self, buffer: RowBuffer) -> None:
        """Send the fields of the rows, once."""
        if not self._announced:
            self._announced = True
            self._link.tell_fields(buffer.fields)

    def _send_rejected(self) -> None:
        """Send the samples that `check_sample` rejected, once the fields' shapes are known."""
        rejected, buffer = self._instance.rejected, self._buffer
        if rejected is None or buffer is None or not self._announced:
            return
        rows = rejected.take(buffer.fields[: -len(ROW_FIELDS)], self._instance.instance_id)
        skipped = max(0, min(self._skip_rejected - self._rejected, len(rows["step"])))
        self._rejected += len(rows["step"])
        for start in range(skipped, len(rows["step"]), buffer.capacity):
            part = {name: values[start : start + buffer.capacity] for name, values in rows.items()}
            self._link.send_parts(pack_rows(part, len(part["step"]), Kind.WRONG))

    def _send_last_rejected(self) -> None:
        """Send the rejected samples of an instance that ended, even if it generated no rows."""
        rejected = self._instance.rejected
        if rejected is None or self._announced:
            return
        fields = rejected.infer_shapes(self._instance.fields)
        if all(field.shape is not None for field in fields):
            self._buffer = RowBuffer(fields)
            self._announce(self._buffer)
            self._send_rejected()

    def _is_due(self) -> bool:
        buffer = self._buffer
        return (
            self.made >= self._credit
            or (buffer is not None and buffer.full)
            or self._clock.monotonic() - self._sent_at >= _BLOCK_TIME
        )

    def _listen(self) -> None:
        """Handle the server's messages, up to the first that applies after the requested rows.

        A client that replaces another one immediately receives all that was sent to the former.
        """
        while self._link.has_message():
            frame = self._link.receive()
            if frame.kind in (Kind.APPLY, Kind.STORED) and self.made < self._credit:
                self._link.put_back(frame)
                return
            self._obey(frame)

    def _obey(self, frame: Frame) -> None:
        self._orders += frame.kind in (Kind.APPLY, Kind.STORED)
        if frame.kind is Kind.CREDIT:
            self._credit = frame.number
        elif frame.kind is Kind.APPLY:
            prediction = decode(frame.payload)
            for row in range(frame.number):
                self._instance.apply({name: values[row] for name, values in prediction.items()})
        elif frame.kind is Kind.STORED:
            stored = decode(frame.payload)
            self._stored.extend(copy_row(stored, row) for row in range(frame.number))
        else:
            self._link.skip(frame)
