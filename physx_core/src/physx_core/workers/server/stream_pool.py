"""StreamPool: what a run of streams does about clients that are lost."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable

from physx_core.clock import Clock
from physx_core.components.services import Services
from physx_core.config import EnvironmentConfig
from physx_core.errors import (
    ClientError,
    ConnectionRefusedByPeerError,
    EnvironmentFailedError,
    PhysxError,
    ProgramError,
)
from physx_core.net.frames import Frame, Kind
from physx_core.net.remote_errors import decode_error
from physx_core.workers.journal import Journal
from physx_core.workers.parameter_sets import ParameterSets
from physx_core.workers.pasts import Skip
from physx_core.workers.row_codec import unpack_rows
from physx_core.workers.server.peer import Peer
from physx_core.workers.server.validation import check_rows, parse_state

_LONG_PAST = 60.0  # s
_PASSING = (EnvironmentFailedError, ProgramError, ClientError)  # errors that may not recur
_LOG = logging.getLogger("physx")


class StreamPool:
    """Clients each of which has a stream until it is lost; then the next client goes on with it.

    Attributes:
        least: How many clients there must be.
        is_ending: Whether no other client is needed.
        dispatch: Handles the messages of a client, by their kind.
        journals: What streams were told, by number, if others may go on with them.
    """

    is_ending = False

    def __init__(
        self,
        config: EnvironmentConfig,
        clock: Clock,
        sets: ParameterSets,
        services: Services,
        skip: Skip,
        *,
        keeps_pasts: bool,
        by_hand: bool,
        address: Callable[[], str],
    ) -> None:
        """Begin without clients.

        Args:
            config: How many streams there are, and how often each may be lost.
            clock: Tells how long clients have lived.
            sets: Chooses the streams' parameters.
            services: Know the parameters that streams have saved.
            skip: What an earlier run already got from the streams.
            keeps_pasts: Whether a later run may go on.
            by_hand: Whether users start the clients.
            address: Returns where these can connect.
        """
        self.least = config.num_clients
        self.dispatch: dict[Kind, Callable[[Peer, Frame], None]] = {
            Kind.ROWS: _take_rows,
            Kind.WRONG: _take_wrong,
            Kind.STATE: self._take_state,
        }
        self._config, self._clock, self._sets, self._services = config, clock, sets, services
        self._skip, self._keeps_pasts, self._has_no_states = skip, keeps_pasts, False
        self._peers: dict[int, Peer] = {}  # the present or last one of each stream
        self.journals: dict[int, Journal] = {}
        self._by_hand, self._address = by_hand, address
        self._losses, self._retries = Counter[int](), config.retries or 0
        self._began = dict.fromkeys(range(1, self.least + 1), clock.monotonic())

    def adopt(self, peer: Peer) -> None:
        """Give a client its stream, with what earlier ones have left."""
        number, keeps = peer.instance_id, self._keeps_pasts
        if number in self._peers:
            peer.succeed(self._peers[number])
        else:
            peer.received = self._skip.rows_of(number, self.least)
            peer.rejected.count = self._skip.rejected_of(number)
            if keeps or self.replaces(number, None):
                limit, past = 1e9 * self._config.journal_size, self._skip.pasts.get(number)
                journal = Journal(number, limit, self._sets, self._services, past, keeps=keeps)
                self.journals[number] = peer.journal = journal
        self._peers[number] = peer

    def close(self) -> None:
        """Forget what the streams were told."""
        for number, journal in self.journals.items():
            journal.close()
            self._peers[number].journal = None

    def replaces(self, number: int, error: PhysxError | None) -> bool:
        """Return whether another client replaces one that failed, or left without an error."""
        if self._given_up(number):
            return False
        if error is None and self._by_hand:
            return True
        passing = error is None or isinstance(error, _PASSING)
        return passing and self._losses[number] < self._retries

    def lose(self, number: int, error: PhysxError, peer: Peer | None, *, launched: bool) -> bool:
        """Give a lost client's stream to the next one, and log what follows.

        Args:
            number: The stream.
            error: How its client was lost.
            peer: Its connection; None: it has none.
            launched: Whether the launcher started it.

        Returns:
            Whether the launcher should start another one.

        Raises:
            PhysxError: If there is none.
        """
        left = peer is not None and peer.closed and not (peer.failure or peer.violation)
        left = left and (not launched or (peer is not None and peer.has_left))
        if (self._by_hand and peer is None) or not self.replaces(number, None if left else error):
            raise self._final(number, error)
        text, _, details = str(error).partition("\n")
        self._losses[number] += not left
        follows = self._describe_next(number)
        if not left:
            follows = f"Restart {self._losses[number]} of {self._retries}. {follows}"
        _LOG.warning("%s. %s%s", text.rstrip("."), follows, details and "\n" + details)
        return True

    def _given_up(self, number: int) -> str:
        """Return why a stream cannot go on although it could before; empty if it can."""
        return self.journals[number].given_up if number in self.journals else ""

    def _final(self, number: int, error: PhysxError) -> PhysxError:
        """Add to an error that ends the run why its stream cannot go on, if so."""
        if reason := self._given_up(number):
            error.add_note(f"{reason}.")
        if peer := self._peers.get(number):
            self._sets.explain(number, peer.episode, error)
        return error

    def _describe_next(self, number: int) -> str:
        peer, began = self._peers.get(number), self._began[number]
        self._began[number] = now = self._clock.monotonic()
        if self.is_ending:
            return "The run was ending, and it has all its rows."
        text = "Another client takes its place."
        if self._by_hand:
            text = (
                f"The run waits up to {self._config.timeout:g} s for another client to take its "
                f"place, at {self._address()}."
            )
        is_long = peer is not None and peer.received > 1 and now - began > _LONG_PAST
        if peer is not None and is_long and not self._config.state_every:
            text += (
                f" It repeats {peer.received} rows first; with EnvironmentConfig.state_every it "
                "would go on from a state."
            )
        return text

    def _take_state(self, peer: Peer, frame: Frame) -> None:
        if frame.number:
            peer.keep_state(frame.number, parse_state(frame.payload))
        elif not self._has_no_states:
            self._has_no_states = True
            _LOG.warning(
                "A client that takes the place of another one, also in a run that is resumed, will "
                "repeat all rows since the last state, as instance %d gives none. %s",
                peer.instance_id,
                decode_error(frame.payload),
            )


def _take_rows(peer: Peer, frame: Frame) -> None:
    count = frame.number
    if not peer.row_fields or not 0 < count <= peer.granted - peer.received:
        raise ConnectionRefusedByPeerError(f"It sent {count} rows that nobody asked for.")
    block = unpack_rows(frame.payload, peer.row_fields, count)
    peer.last_step = check_rows(block, peer.row_fields, peer.instance_id, peer.last_step)
    peer.rows.append(block, count)
    peer.received += count
    peer.pace.rows(count, goes_on=peer.received < peer.granted)


def _take_wrong(peer: Peer, frame: Frame) -> None:
    count = frame.number
    if not peer.row_fields or not 0 < count <= peer.rejected_limit - peer.rejected.count:
        raise ConnectionRefusedByPeerError(f"It sent {count} rejected rows that nobody asked for.")
    block = unpack_rows(frame.payload, peer.row_fields, count)
    check_rows(block, peer.row_fields, peer.instance_id, peer.last_step)
    peer.rejected.append(block, count)
