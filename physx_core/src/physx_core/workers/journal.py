"""Journal: what a stream was told since the states from which it may go on.

A client that takes the place of a lost one begins with the newest state and is told again what came
after it. A later run begins with a `Past`: the newest state before the last row that is stored, and
the predictions after it.
"""

from __future__ import annotations

import contextlib
import logging
import tempfile
from array import array
from bisect import bisect_left
from collections import deque
from dataclasses import replace
from typing import Any

from physx_core.components.services import Services
from physx_core.errors import ClientError
from physx_core.net.frames import HEADER, Kind
from physx_core.workers.parameter_sets import ParameterSets
from physx_core.workers.pasts import Answer, Past

_IN_MEMORY = 1 << 22
_ORDERS = (Kind.CREDIT, Kind.APPLY, Kind.STORED)
_LOG = logging.getLogger("physx")


class Journal:
    """Keeps the states of a stream, and what it was told.

    Orders are the messages that a client obeys between two rows: credit, predictions to apply,
    stored rows. Of successive credits only the last is kept, so the journal of a stream that only
    generates rows does not grow. A state takes the place of all that was told before it but the
    answers that the environment got before its first row, as each client creates it anew.

    A journal that reaches its limit, or for which the disk has no space, is given up: it forgets
    everything, the run goes on, and a warning says that the stream can no longer be restarted.

    Attributes:
        given_up: Why, as a sentence; empty: it is complete.
        credit: The credit given after all other orders; empty if there is none.
        answers: Largest number of a request whose answer it has got, counted from 1; 0: none.
    """

    def __init__(
        self,
        number: int,
        limit: float,
        sets: ParameterSets,
        services: Services,
        former: Past | None = None,
        *,
        keeps: bool = False,
    ) -> None:
        """Begin with what an earlier run has left.

        Args:
            number: Number of the stream, counted from 1.
            limit: Largest size in bytes since a state.
            sets: Knows the sets of parameters that the stream has been given.
            services: Know the parameters that it has saved.
            former: What an earlier run has left; None: nothing.
            keeps: Whether a later run may go on: somebody calls `at`.
        """
        self.given_up, self.credit, self.answers = "", b"", 0
        self._number, self._limit, self._keeps = number, limit, keeps
        self._sets, self._services = sets, services
        self._former = former = former or Past()
        self._told = deque(former.told)
        self._created, self._is_created = State(Past()), False
        self._states = deque([State(replace(former, created=(), answers=[], count=0))])

    @property
    def newest(self) -> State:
        """The newest state; its past has none if the stream begins anew."""
        return self._states[-1]

    def end_creation(self) -> None:
        """Note that the stream is created; it then has the parameters that its past had saved.

        Further calls, for a client that takes the place of another one, do nothing.
        """
        if not self._is_created and self._former.saved:
            self._services.save_parameters(self._number, dict(self._former.saved))
        self._is_created = True

    def keep_state(self, past: Past, *, obeyed: int = 0, shown: int = 0, requests: int = 0) -> None:
        """Keep a state, and forget what a client that begins with it is not told.

        If the disk has no space, the journal stays as it is, with the state before.

        Args:
            past: The state, and how many rows and rejected samples there were before.
            obeyed: How many orders other than credit its client had obeyed.
            shown: How many messages with drawing events this had sent.
            requests: How many requests this had sent.

        Raises:
            ClientError: If the journal cannot be read.
        """
        if self.given_up or past.rows <= self.newest.past.rows:
            return
        if self._keeps:
            recorded, given = self._sets.waiting(self._number)
            saved = self._services.load_parameters(self._number)
            past = replace(past, recorded=recorded, sets=given, saved=saved)
        fresh = State(past, obeyed, shown, requests)
        try:
            for index in range(obeyed, self.newest.next_order):
                fresh.orders.put(index, self.order(index) or b"")
        except OSError:
            fresh.close()
            return
        self._states.append(fresh)
        if not self._keeps:
            self._states.popleft().close()

    def at(self, rows: int) -> Past | None:
        """Return what a later run needs to go on after some rows, and forget what was before.

        Args:
            rows: How many rows of the stream it will have.

        Returns:
            The newest state that is not after them, and the predictions since; None: the journal
            has been given up, or closed.
        """
        if not self._keeps:
            return None
        while len(self._states) > 1 and self._states[1].past.rows <= rows:
            self._states.popleft().close()
        past = self._states[0].past
        return replace(past, created=tuple(self._created.past.answers), count=len(past.answers))

    def tell(self) -> Answer | None:
        """Return what an earlier run answered to the next request for a prediction."""
        return self._told.popleft() if self._told else None

    def record(self, message: bytes, *, is_prediction: bool = False, is_read: bool = False) -> bool:
        """Keep a message if the next client will need it; return whether it is an order.

        Args:
            message: The message.
            is_prediction: Whether it answers a request for a prediction, which a later run needs.
            is_read: Whether the present client has yet to be told what is in the journal; until
                then it grows beyond its limit.

        Raises:
            ClientError: If that client cannot be told, as the disk has no space for the message.
        """
        _, kind, _, number = HEADER.unpack_from(message)
        if self.given_up:
            return kind in _ORDERS
        try:
            if kind == Kind.CREDIT:
                self.credit = bytes(message)
            elif kind in _ORDERS:
                self.newest.orders.put(self.newest.next_order, self.credit + message)
                self.credit = b""
            elif kind in (Kind.ANSWER, Kind.REFUSAL):
                self._place.answers.put(number, message)
                self.answers = max(number, self.answers)
                if is_prediction and self._keeps:
                    answer = kind == Kind.ANSWER, bytes(message[HEADER.size :])
                    self._place.past.answers.append(answer)
        except OSError as error:
            if is_read:
                raise self._failure(error) from error
            self._give_up(f"cannot grow in {_folder()}: {error.strerror}")
        if not is_read:
            self._check_size()
        return kind in _ORDERS

    def answer(self, number: int) -> bytes | None:
        """Return the answer to a request; None if there is none yet.

        Args:
            number: Number of the request, counted from 1.
        """
        return self._find(self._created.answers, number) or self._find(self.newest.answers, number)

    def order(self, index: int) -> bytes | None:
        """Return an order, with the credit before it; None if there are no more.

        Args:
            index: Its index, counted from 0 since the run began, at least `State.obeyed`.
        """
        return self._find(self.newest.orders, index)

    def _find(self, messages: _Messages, number: int) -> bytes | None:
        try:
            return messages.find(number)
        except OSError as error:
            raise self._failure(error) from error

    def close(self) -> None:
        """Forget everything; calling it again does nothing."""
        for state in (self._created, *self._states):
            state.close()
        self._created, self._states, self.credit = State(Past()), deque([State(Past())]), b""
        self._keeps = False

    @property
    def size(self) -> int:
        """Size in bytes of what the next client will be told."""
        return self._created.size + self.newest.size

    @property
    def _place(self) -> State:
        """Where answers are kept."""
        return self.newest if self._is_created else self._created

    def _check_size(self) -> None:
        if self.size > self._limit and not self.given_up:
            limit = f"{self._limit / 1e9:g} GB"
            self._give_up(
                f"has reached its limit, EnvironmentConfig.journal_size = {limit}; take states "
                "more often (state_every)"
            )

    def _give_up(self, reason: str) -> None:
        self.close()
        self.given_up = (
            f"Instance {self._number} can no longer be restarted, nor go on in a later run: the "
            f"journal of what it was told {reason}"
        )
        _LOG.warning("%s. This run goes on.", self.given_up)

    def _failure(self, error: OSError) -> ClientError:
        return ClientError(
            self._number,
            "cannot be told what its predecessor was told: the journal of that, in "
            f"{_folder()}, fails: {error.strerror}. Free some space there, or name "
            "another folder with the environment variable TMPDIR.",
        )


class State:
    """A state of a stream, and what this was told after it.

    Attributes:
        past: What a later run needs, but for the answers before the first row.
        obeyed: How many orders other than credit were obeyed before.
        shown: How many messages with drawing events were sent before; None: in an earlier run.
        requests: How many requests were sent before; None: in an earlier run.
        orders: The orders after it by their index, counted from 0 since the run began, each with
            the credit before it.
        answers: The answers to requests after it, by number of the request.
    """

    def __init__(
        self, past: Past, obeyed: int = 0, shown: int | None = None, requests: int | None = None
    ) -> None:
        """Begin without what follows."""
        self.past, self.obeyed, self.shown, self.requests = past, obeyed, shown, requests
        self.orders, self.answers = _Messages(), _Messages()

    @property
    def next_order(self) -> int:
        """Index of the next order, counted from 0 since the run began."""
        return self.obeyed + len(self.orders)

    @property
    def size(self) -> int:
        """Size in bytes of what is kept."""
        return len(self.past.state) + self.orders.size + self.answers.size

    def describe(self) -> dict[str, Any] | None:
        """Return what a client needs to begin with it; None: it begins anew."""
        if not self.past.state:
            return None
        counts = {"orders": self.obeyed, "shown": self.shown, "requests": self.requests}
        kept = {"rows": self.past.rows, "rejected": self.past.rejected, "state": self.past.state}
        return counts | kept

    def close(self) -> None:
        """Forget what follows; pasts that have been taken stay as they are."""
        self.orders.close()
        self.answers.close()


class _Messages:
    """Messages by number, in a temporary file once there are many."""

    def __init__(self) -> None:
        self.size = 0
        self._file = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115 - see close
        self._numbers, self._begins, self._sizes = array("Q"), array("Q"), array("Q")

    def __len__(self) -> int:
        return len(self._numbers)

    def put(self, number: int, message: bytes) -> None:
        self._file.seek(self.size)
        self._file.write(message)
        self._file.flush()  # a full disk is noticed now, not when a client needs the message
        place = bisect_left(self._numbers, number)  # the last one, unless one was left out before
        self._numbers.insert(place, number)
        self._begins.insert(place, self.size)
        self._sizes.insert(place, len(message))
        self.size += len(message)

    def find(self, number: int) -> bytes | None:
        place = bisect_left(self._numbers, number)
        if place == len(self) or self._numbers[place] != number:
            return None
        self._file.seek(self._begins[place])
        return self._file.read(self._sizes[place])

    def close(self) -> None:
        with contextlib.suppress(OSError):  # of what is still to be written
            self._file.close()


def _folder() -> str:
    try:
        return tempfile.gettempdir()
    except OSError:  # no folder can be written to
        return "any folder for temporary files"
