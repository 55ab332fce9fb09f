"""Journal: log of the server's messages to one instance, replayed to a restarted client."""

from __future__ import annotations

import tempfile
from array import array

from physx_core.net.frames import HEADER, Kind

_IN_MEMORY = 1 << 22


class Journal:
    """Keeps answers by request number, and orders in the order in which they were given.

    Orders are the messages that a client obeys between two rows: credit, predictions to apply,
    stored rows. Of successive credits only the last is kept, so the journal of an instance that
    only generates rows does not grow. Other messages are kept unmodified, in a temporary file once
    there are many.
    """

    def __init__(self) -> None:
        """Start empty."""
        self._messages = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115 - see close
        self._size = 0
        self._answers = array("Q")  # request number - 1 to the offset of its answer + 1; 0: none
        self._orders = array("Q")
        self._credit = b""

    def record(self, message: bytes) -> bool:
        """Keep a message if a successor will need it; return whether it is an order."""
        _, kind, _, number = HEADER.unpack_from(message)
        if kind == Kind.CREDIT:
            self._credit = bytes(message)
        elif kind in (Kind.APPLY, Kind.STORED):
            if self._credit:
                self._orders.append(self._write(self._credit))
                self._credit = b""
            self._orders.append(self._write(message))
        elif kind in (Kind.ANSWER, Kind.REFUSAL):
            missing = number - len(self._answers)
            self._answers.frombytes(bytes(max(0, missing) * self._answers.itemsize))
            self._answers[number - 1] = self._write(message) + 1
        return kind in (Kind.CREDIT, Kind.APPLY, Kind.STORED)

    def answer(self, number: int) -> bytes | None:
        """Return the answer to a request; None if there is none yet.

        Args:
            number: Number of the request, counted from 1.
        """
        place = self._answers[number - 1] if number <= len(self._answers) else 0
        return self._read(place - 1) if place else None

    def order(self, index: int) -> bytes | None:
        """Return an order other than a final credit, counted from 0; None if there are no more."""
        return self._read(self._orders[index]) if index < len(self._orders) else None

    @property
    def credit(self) -> bytes:
        """The credit given after all other orders; empty if there is none."""
        return self._credit

    def close(self) -> None:
        """Forget everything; calling it again does nothing."""
        self._messages.close()

    def _write(self, message: bytes) -> int:
        place = self._size
        self._messages.seek(place)
        self._messages.write(message)
        self._size += len(message)
        return place

    def _read(self, place: int) -> bytes:
        self._messages.seek(place)
        head = self._messages.read(HEADER.size)
        return head + self._messages.read(HEADER.unpack(head)[0])
