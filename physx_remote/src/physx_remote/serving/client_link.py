"""RequestLink: a client's connection on which each message gets one answer."""

from __future__ import annotations

from typing import Any

from physx_core.errors import ConfigError
from physx_core.net import SOCKETS, Link, Transport
from physx_remote.errors import RemoteClosedError
from physx_remote.serving.client_connection import ClientConnection
from physx_remote.serving.framing import MAX_ANSWER, PrefixReader, add_prefix

_LONGEST = 1e9


class RequestLink(ClientConnection):
    """A connection on which each message is answered by one message.

    It is closed after any failure: a late answer must not be mistaken for that of another message.
    """

    def __init__(
        self,
        address: tuple[str, int],
        *,
        timeout: float | None = 60.0,
        connect_timeout: float = 10.0,
        max_answer: int = MAX_ANSWER,
        transport: Transport = SOCKETS,
    ) -> None:
        """Connect; retry while nothing listens.

        Args:
            address: Host and port.
            timeout: Time limit for an answer in s; None: no limit.
            connect_timeout: Time in s to keep trying to connect.
            max_answer: Longest accepted answer in bytes.
            transport: What connects, and the clock that the time limits follow.
        """
        if timeout is not None:
            _check_time("timeout", timeout)
        _check_time("connect_timeout", connect_timeout)
        if type(max_answer) is not int or max_answer < 1:
            raise ConfigError(
                f"max_answer is {max_answer!r} but must be a positive integer (bytes)."
            )
        super().__init__(address, transport)
        self._timeout = timeout
        self._reader = PrefixReader(max_answer)
        self._socket = self._connected(address, connect_timeout)
        self._begin()

    def _connected(self, address: tuple[str, int], patience: float) -> Link:
        return self._reach(lambda left: self._transport.connect(address, left), patience)

    def tell(self, body: bytes) -> None:
        """Send a message that has no answer."""
        self._send(add_prefix(body), self._timeout)

    def exchange(self, body: bytes) -> bytes:
        """Send a message and return its answer."""
        try:
            self.tell(body)
            return self._answer()
        except OSError as error:
            raise self._broken(error) from error
        except BaseException as error:
            self.close(f"{type(error).__name__} {error}".rstrip())
            raise

    def _answer(self) -> bytes:
        left = self._timeout
        until = None if left is None else self._clock.monotonic() + left
        while True:
            if not self._wait(left):
                raise self._late(self._timeout)
            if not self._reader.receive(self._socket):
                place = f" within an answer, after {n} bytes" if (n := self._reader.waiting) else ""
                raise RemoteClosedError(f"{self.name} closed the connection{place}.")
            body = self._reader.take()
            if body is not None:
                return body
            left = None if until is None else max(0.0, until - self._clock.monotonic())


def _check_time(name: str, seconds: Any) -> None:
    if type(seconds) not in (int, float) or not 0 < seconds < _LONGEST:
        raise ConfigError(f"{name} is {seconds!r} but must be a positive number of seconds.")
