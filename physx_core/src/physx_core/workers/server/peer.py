"""Peer: a connection of the server, at first a stranger's, and what its client has sent."""

from __future__ import annotations

import contextlib

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.components.parameter import Parameter
from physx_core.errors import ConnectionRefusedByPeerError, PhysxError
from physx_core.fields import Field
from physx_core.net.connection import Connection
from physx_core.net.frames import FrameReader
from physx_core.net.handshake import HANDSHAKE_LIMIT
from physx_core.net.link import Link
from physx_core.workers.journal import Journal
from physx_core.workers.pasts import Past
from physx_core.workers.row_codec import ReceivedRows, RejectedRows
from physx_core.workers.server.pace import Pace
from physx_core.workers.server.validation import ClientState

_PIECE = 1 << 16


class Peer(Connection):
    """One connection of the server, and what its client has sent.

    Attributes:
        reader: Reads its frames.
        instance_id: Number of its instance, counted from 1; 0 while it is a stranger.
        fields: The environment's fields; empty before it is ready.
        episode_fields: Those that each of its episodes has once.
        is_independent: Whether the environment's episodes are independent.
        row_fields: Fields of its rows, all shapes known; empty before the first sample.
        rows: Rows that arrived.
        received: How many rows arrived in total.
        granted: How many rows it may generate in total.
        wanted: How many of them the run waits for or already got; it generates the others ahead.
        rejected: Rejected rows that arrived.
        rejected_limit: How many of those it may send in total.
        failure: The error that it sent.
        failed_row: Row, counted from 0, at which the error occurred.
        last_step: Step of its last row, -1 before the first.
        violation: The protocol violation for which it was cut off; empty if there is none.
        has_vanished: Whether its machine no longer answers.
        has_left: Whether it left the run on purpose.
        finished: Whether it reported that its environment is closed.
        vacant: Whether another client may take the instance's place.
        has_told_fields: Whether it sent the fields of its rows.
        requests: How many requests it sent.
        shown: How many messages with drawing events arrived in total.
        journal: Messages for a client that takes its place; None if none can.
        parameters: The parameters that its environment defines.
        episode: Last episode that it was given parameters for; -1: none.
        pace: How fast this client generates rows.
        resumed_requests: How many requests there were before the state that it begins with; None:
            it begins without one.
    """

    reader: FrameReader

    def __init__(self, link: Link, name: str, clock: Clock = SYSTEM_CLOCK) -> None:
        """Take a new connection.

        Args:
            link: The link to its client.
            name: The other side as ``host:port``.
            clock: Tells how long the client takes.
        """
        super().__init__(link, FrameReader(HANDSHAKE_LIMIT), name, clock)
        self.instance_id = 0
        self.fields: list[Field] = []
        self.episode_fields: list[Field] = []
        self.is_independent = False
        self.row_fields: list[Field] = []
        self.rows = ReceivedRows()
        self.received = self.granted = self.wanted = 0
        self.rejected = RejectedRows()
        self.rejected_limit = 0
        self.failure: PhysxError | None = None
        self.failed_row = 0
        self.last_step = -1
        self.violation = ""
        self.has_vanished = self.has_left = self.finished = self.vacant = False
        self.has_told_fields = False
        self.requests = self.shown = 0
        self.journal: Journal | None = None
        self.parameters: list[Parameter] = []
        self.episode = -1
        self.pace = Pace(clock)
        self._arrived = 0  # of a long frame, when the peer was last heard from
        self.resumed_requests: int | None = None
        self._next_order: int | None = None  # of the journal's, for this client; None: it got all

    @property
    def is_awaited(self) -> bool:
        """Whether its environment is starting, or generating rows that the run waits for.

        For a lost client: whether it would be.
        """
        return not self.finished and (not self.fields or self.received < self.wanted)

    @property
    def is_ahead(self) -> bool:
        """Whether its environment is generating a row that the run does not wait for yet."""
        return bool(self.fields) and self.wanted <= self.received < self.granted

    @property
    def is_lost(self) -> bool:
        """Whether this client generates no more rows."""
        return self.closed or self.failure is not None

    def succeed(self, former: Peer) -> None:
        """Take the place of the instance's former client, with everything that it sent."""
        self.rows, self.received, self.granted = former.rows, former.received, former.granted
        self.wanted = former.wanted
        self.rejected, self.rejected_limit = former.rejected, former.rejected_limit
        self.row_fields, self.last_step = former.row_fields, former.last_step
        self.shown, self.journal = former.shown, former.journal
        self.episode = former.episode
        if self.journal is not None:
            self._next_order = self.journal.newest.obeyed
            self.resumed_requests = self.journal.newest.requests

    def keep_state(self, rows: int, state: ClientState) -> None:
        """Keep a state for a client that takes its place, or a later run.

        Args:
            rows: How many rows came before it.
            state: The state, and counts that come with it.

        Raises:
            ConnectionRefusedByPeerError: If the counts cannot be right.
        """
        journal = self.journal
        if not 0 < rows <= self.received or not (
            state["shown"] <= self.shown and state["rejected"] <= self.rejected.count
        ):
            raise ConnectionRefusedByPeerError("Its state is after rows that it has not sent.")
        if journal is None or journal.given_up:
            return
        newest, sent = journal.newest, self._next_order
        sent = newest.next_order if sent is None else sent
        if not newest.obeyed <= state["orders"] <= sent:
            raise ConnectionRefusedByPeerError("Its state is after orders that nobody gave.")
        past, shown = Past(rows, state["state"], state["rejected"]), state["shown"]
        journal.keep_state(past, obeyed=state["orders"], shown=shown, requests=self.requests)

    def hear(self, *, whole: bool) -> None:
        """Note a sign of life: a whole frame, or a substantial part of a long one.

        A few bytes from time to time do not count.
        """
        arrived = 0 if whole else self.reader.arrived
        if whole or arrived - self._arrived >= _PIECE:
            self.heard, self._arrived = self._clock.monotonic(), arrived

    def send(self, message: bytes, *, is_prediction: bool = False) -> None:
        """Send as much as the connection takes now; `flush` sends the rest.

        What a successor will need goes into the journal. A client that has just taken a place gets
        the orders from there, one after another.

        Args:
            message: The message.
            is_prediction: Whether it answers a request for a prediction.
        """
        is_order = self.journal is not None and self.journal.record(
            message,
            is_prediction=is_prediction,
            is_read=self._next_order is not None or self.requests < self.journal.answers,
        )
        if self._next_order is None or not is_order:
            self.send_once(message)

    def send_once(self, message: bytes) -> None:
        """Send a message that no successor needs."""
        if self.closed:
            return
        if self.outgoing or self._next_order is not None:
            self.outgoing += message
            self.flush()
        else:
            try:
                self.write(message)
            except OSError:  # reading notices its end
                self.outgoing.clear()
        self.heard = self._clock.monotonic()  # its time to react starts now

    def flush(self) -> int:
        """Send what is pending, then the journal's orders, as far as the connection takes them."""
        total = 0
        with contextlib.suppress(OSError):  # reading notices its end
            while self.outgoing or self._take_order():
                sent = super().flush()
                if not sent:
                    break
                total += sent
        return total

    def _take_order(self) -> bool:
        """Fetch the next order from the journal; return whether there is something to send."""
        if self.journal is None or self._next_order is None:
            return False
        order = self.journal.order(self._next_order)
        self._next_order = None if order is None else self._next_order + 1
        self.outgoing += self.journal.credit if order is None else order
        return bool(self.outgoing)
