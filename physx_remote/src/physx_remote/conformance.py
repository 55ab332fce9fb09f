"""Checks that a protocol satisfies its contract."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator

from physx_remote.errors import RemoteError
from physx_remote.serving.protocol import Protocol
from physx_remote.serving.service import Service
from physx_remote.serving.worlds import open_worlds
from physx_testing.report import NotApplicableError
from physx_testing.subject import Check, Subject, expect, refuses_unknown_options

_HOST = "127.0.0.1"


@contextlib.contextmanager
def _served(subject: Subject) -> Iterator[Service]:
    """Yield a service of CartPole, at a free port."""
    protocol: Protocol = subject.make()
    worlds = open_worlds("CartPole-v1", 1)
    try:
        service = protocol.service(worlds, address=_HOST, port=0)
    except RemoteError as error:
        worlds.close()
        raise NotApplicableError(f"its services connect to another program: {error}") from error
    with service:
        yield service


def _serves(subject: Subject) -> None:
    with _served(subject) as service:
        host, port = service.address
        expect(host == _HOST and port > 0, f"its service says that it listens at {host}:{port}")
        expect(service.poll(0.01) is True, "poll() does not return True before any client came")
        with contextlib.suppress(ConnectionRefusedError), socket.create_connection((host, port)):
            expect(service.poll(0.1) is True, "a client that says nothing ends the service")


def _closes(subject: Subject) -> None:
    with _served(subject) as service:
        host, port = service.address
        service.close()
        service.close()
        expect(service.poll(0.01) is False, "poll() does not return False after close()")
    with socket.socket() as another:
        another.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        another.bind((host, port))


def _has_a_name(subject: Subject) -> None:
    name = subject.make().name
    expect(isinstance(name, str) and name, "it has no name")


CHECKS: dict[str, Check] = {
    "has a name": _has_a_name,
    "refuses unknown options": refuses_unknown_options,
    "serves an environment": _serves,
    "closes for good, and frees its port": _closes,
}
