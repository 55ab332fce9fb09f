"""Journal: log of the server's messages to one instance, replayed to a restarted client."""

from __future__ import annotations

import contextlib
import logging
import tempfile
from array import array

from physx_core.errors import ClientError
from physx_core.net.frames import HEADER, Kind, pack

_IN_MEMORY = 1 << 22
_ORDERS = (Kind.CREDIT, Kind.APPLY, Kind.STORED)
_LOG = logging.getLogger("physx")


class Journal:
    """Keeps answers by request number, and orders in the order in which they were given.

    Orders are the messages that a client obeys between two rows: credit, predictions to apply,
    stored rows. Of successive credits only the last is kept, so the journal of an instance that
    only generates rows does not grow. Other messages are kept unmodified, in a temporary file once
    there are many. A state of the instance takes the place of all messages before it but the
    answers that the environment got before its first row, as each client creates it anew.

    A journal that reaches its limit, or for which the disk has no space, is given up: it forgets
    everything, the run goes on, and a warning says that the instance can no longer be restarted.

    Attributes:
        given_up: Why, as a sentence; empty: it is complete.
        size: Size in bytes.
        created: How many requests the first client sent before its first row.
        first_order: Index of the first order that it has, counted from 0 since the run began.
    """

    def __init__(self, instance_id: int, limit: float) -> None:
        """Start empty.

        Args:
            instance_id: Number of the instance, from 1.
            limit: Largest size in bytes.
        """
        self._instance_id, self._limit = instance_id, limit
        self.given_up = ""
        self._messages = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115 - see close
        self.size = 0
        self._answers = array("Q")  # request number - 1 to the offset of its answer + 1; 0: none
        self._orders = array("Q")
        self._credits = bytearray()  # whether an order is a credit
        self._credit = b""
        self.created = self.first_order = 0
        self._obeyed = self._gap = 0  # orders other than credit, and answers, before the state
        self._has_state = False

    @property
    def state(self) -> bytes | None:
        """The last state; None if there is none."""
        return self._read(0)[HEADER.size :] if self._has_state else None

    @property
    def resumed_requests(self) -> int | None:
        """How many requests there were before the last state; None if there is none."""
        return self.created + self._gap if self._has_state else None

    def find_order(self, obeyed: int) -> int | None:
        """Return the index of the order after a number of orders other than credit, if known."""
        missing = obeyed - self._obeyed
        index = 0
        while missing > 0 and index < len(self._orders):
            missing -= not self._credits[index]
            index += 1
        return None if missing else self.first_order + index

    def keep_state(self, state: bytes, obeyed: int, requests: int) -> None:
        """Keep a state, and forget what a client that begins with it is not told.

        If the disk has no space, the journal stays as it is, with the state before.

        Args:
            state: The state.
            obeyed: How many orders other than credit the client had obeyed.
            requests: How many requests it had sent.

        Raises:
            ClientError: If the journal cannot be read.
        """
        first = self.find_order(obeyed)
        if self.given_up or first is None:
            return
        fresh, begin = Journal(self._instance_id, self._limit), first - self.first_order
        try:
            fresh._write(pack(Kind.STATE, state))
            answers = self._answers[: self.created] + self._answers[requests - self._gap :]
            fresh._answers.extend(
                place and fresh._write(self._read(place - 1)) + 1 for place in answers
            )
            fresh._orders.extend(fresh._write(self._read(each)) for each in self._orders[begin:])
        except OSError:
            fresh.close()
            return
        self.close()
        self._messages, self.size = fresh._messages, fresh.size
        self._answers, self._orders = fresh._answers, fresh._orders
        self._credits = self._credits[begin:]
        self.first_order, self._obeyed, self._gap = first, obeyed, requests - self.created
        self._has_state = True

    def record(self, message: bytes, *, is_read: bool = False) -> bool:
        """Keep a message if a successor will need it; return whether it is an order.

        Args:
            message: The message.
            is_read: Whether the instance's client has yet to be told what is in the journal; until
                then it grows beyond its limit.

        Raises:
            ClientError: If that client cannot be told, as the disk has no space for the message.
        """
        _, kind, _, number = HEADER.unpack_from(message)
        if self.given_up:
            return kind in _ORDERS
        try:
            self._keep(message, kind, number)
        except OSError as error:
            if is_read:
                raise self._failure(error) from error
            self._give_up(f"cannot grow in {_folder()}: {error.strerror}")
        if self.size > self._limit and not is_read:
            limit = f"{self._limit / 1e9:g} GB"
            self._give_up(f"has reached its limit, EnvironmentConfig.journal_size = {limit}")
        return kind in _ORDERS

    def _keep(self, message: bytes, kind: int, number: int) -> None:
        if kind == Kind.CREDIT:
            self._credit = bytes(message)
        elif kind in (Kind.APPLY, Kind.STORED):
            if self._credit:
                self._add_order(self._credit, is_credit=True)
                self._credit = b""
            self._add_order(message)
        elif kind in (Kind.ANSWER, Kind.REFUSAL):
            place = self._place_of(number)
            missing = place + 1 - len(self._answers)
            self._answers.frombytes(bytes(max(0, missing) * self._answers.itemsize))
            self._answers[place] = self._write(message) + 1

    def _add_order(self, message: bytes, *, is_credit: bool = False) -> None:
        self._orders.append(self._write(message))
        self._credits.append(is_credit)

    def _place_of(self, number: int) -> int:
        """Return the place of the answer to a request among those that are kept."""
        return number - 1 - (self._gap if number > self.created else 0)

    @property
    def answers(self) -> int:
        """Largest number of a request whose answer it holds, counted from 1; 0: none."""
        return len(self._answers) + self._gap

    def answer(self, number: int) -> bytes | None:
        """Return the answer to a request; None if there is none yet.

        Args:
            number: Number of the request, counted from 1.
        """
        place = self._place_of(number)
        start = self._answers[place] if place < len(self._answers) else 0
        return self._read(start - 1) if start else None

    def order(self, index: int) -> bytes | None:
        """Return an order other than a final credit; None if there are no more.

        Args:
            index: Its index, counted from 0 since the run began, at least `first_order`.
        """
        place = index - self.first_order
        return self._read(self._orders[place]) if place < len(self._orders) else None

    @property
    def credit(self) -> bytes:
        """The credit given after all other orders; empty if there is none."""
        return self._credit

    def close(self) -> None:
        """Forget everything; calling it again does nothing."""
        with contextlib.suppress(OSError):  # of what is still to be written
            self._messages.close()

    def _give_up(self, reason: str) -> None:
        self.close()
        self._answers, self._orders, self._credit = array("Q"), array("Q"), b""
        self._credits, self._has_state, self._gap = bytearray(), False, 0
        self.given_up = (
            f"Instance {self._instance_id} can no longer be restarted: the journal of what its "
            f"client was told {reason}"
        )
        _LOG.warning("%s. The run goes on, but would end with that client.", self.given_up)

    def _failure(self, error: OSError) -> ClientError:
        return ClientError(
            self._instance_id,
            "cannot be told what its predecessor was told: the journal of that, in "
            f"{_folder()}, fails: {error.strerror}. Free some space there, or name "
            "another folder with the environment variable TMPDIR.",
        )

    def _write(self, message: bytes) -> int:
        place = self.size
        self._messages.seek(place)
        self._messages.write(message)
        self._messages.flush()  # a full disk is noticed now, not when a client needs the message
        self.size += len(message)
        return place

    def _read(self, place: int) -> bytes:
        try:
            self._messages.seek(place)
            head = self._messages.read(HEADER.size)
            return head + self._messages.read(HEADER.unpack(head)[0])
        except OSError as error:
            raise self._failure(error) from error


def _folder() -> str:
    try:
        return tempfile.gettempdir()
    except OSError:  # no folder can be written to
        return "any folder for temporary files"
