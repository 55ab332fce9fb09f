"""RequestLink: a client's connection on which each message is answered by one message."""

from __future__ import annotations

import socket
import time
from typing import Any

from physx_core.errors import ConfigError, RemoteClosedError, RemoteTimeoutError
from physx_remote.serving.client_connection import ClientConnection
from physx_remote.serving.framing import MAX_ANSWER, PrefixReader, add_prefix

_LONGEST = 1e9


class RequestLink(ClientConnection):
    """A connection on which each message is answered by one message; every wait has an end.

    After any failure it is closed: a late answer must not be taken for that of another message.
    """

    def __init__(
        self,
        address: tuple[str, int],
        *,
        timeout: float | None = 60.0,
        connect_timeout: float = 10.0,
        max_answer: int = MAX_ANSWER,
    ) -> None:
        """Connect, and try again as long as nothing listens.

        Args:
            address: Host and port.
            timeout: How long an answer may take, in s; None: forever.
            connect_timeout: How long to try to connect, in s.
            max_answer: Longest answer in bytes that is accepted.
        """
        if timeout is not None:
            _check_time("timeout", timeout)
        _check_time("connect_timeout", connect_timeout)
        if type(max_answer) is not int or max_answer < 1:
            raise ConfigError(
                f"max_answer is {max_answer!r} but must be a positive integer (bytes)."
            )
        super().__init__(address)
        self._timeout = timeout
        self._reader = PrefixReader(max_answer)
        self._socket = self._connected(address, connect_timeout)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(timeout)

    def _connected(self, address: tuple[str, int], patience: float) -> socket.socket:
        return self._reach(lambda left: socket.create_connection(address, left), patience)

    def exchange(self, body: bytes) -> bytes:
        """Send a message and return the answer to it."""
        self._check_open()
        try:
            self._socket.sendall(add_prefix(body))
            return self._answer()
        except TimeoutError as error:
            self.close(f"an answer took longer than {self._timeout} s")
            raise RemoteTimeoutError(
                f"{self.name} did not answer within {self._timeout} s; it may be busy with another "
                "client, or be waiting for it. The connection is closed."
            ) from error
        except OSError as error:
            self.close(str(error))
            raise RemoteClosedError(f"The connection to {self.name} broke: {error}.") from error
        except BaseException as error:
            self.close(f"{type(error).__name__} {error}".rstrip())
            raise

    def _answer(self) -> bytes:
        until = None if self._timeout is None else time.monotonic() + self._timeout
        while True:
            if not self._reader.receive(self._socket):
                place = f" within an answer, after {n} bytes" if (n := self._reader.waiting) else ""
                raise RemoteClosedError(f"{self.name} ended the connection{place}.")
            body = self._reader.take()
            if body is not None:
                break
            if until is not None:
                left = until - time.monotonic()
                if left <= 0:
                    raise TimeoutError
                self._socket.settimeout(left)
        if until is not None:
            self._socket.settimeout(self._timeout)
        return body


def _check_time(name: str, seconds: Any) -> None:
    if type(seconds) not in (int, float) or not 0 < seconds < _LONGEST:
        raise ConfigError(f"{name} is {seconds!r} but must be a positive number of seconds.")
