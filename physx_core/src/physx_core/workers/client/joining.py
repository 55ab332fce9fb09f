"""Connects a client to its server and receives what to run."""

from __future__ import annotations

import socket
from typing import Any

from physx_core.errors import ConfigError, ConnectionRefusedByPeerError, UnansweredError
from physx_core.net.addresses import parse_address, retry
from physx_core.net.frames import Kind
from physx_core.net.handshake import PlainRefusedError, encrypt, introduce
from physx_core.net.link import SOCKETS, Link, Transport
from physx_core.net.liveness import prepare_connection
from physx_core.net.remote_errors import decode_error
from physx_core.net.values import decode
from physx_core.workers.client.link import RunEnded, WorkerLink

PATIENCE = 10.0
"""How long a client tries to join, in s."""

_PAUSE = 0.2


def join(
    address: str,
    token: str,
    instance: int,
    patience: float = PATIENCE,
    answer_time: float | None = None,
    transport: Transport = SOCKETS,
) -> tuple[WorkerLink, dict[str, Any]]:
    """Connect to a server and receive what to run.

    Retries if nothing listens, or if the server closes the connection during the handshake, as it
    does with some connections while there are too many.

    Args:
        address: ``HOST:PORT``.
        token: Token of the run.
        instance: Number of the instance to run, 0 for any that is free.
        patience: How long to retry, in s.
        answer_time: How long a server that accepted the connection may take to answer, in s; None:
            without limit, as its run may be busy, for example with a long validation.
        transport: What connects the client, and the clock that it follows.

    Returns:
        The connection, and the arguments of the instance.
    """

    def attempt(seconds: float) -> tuple[WorkerLink, dict[str, Any]]:
        try:
            return _try_to_join(transport, address, token, instance, answer_time)
        except PlainRefusedError:
            return _try_to_join(transport, address, token, instance, answer_time, encrypted=True)

    return retry(attempt, patience, _PAUSE, UnansweredError, clock=transport.clock)


def _try_to_join(
    transport: Transport,
    address: str,
    token: str,
    instance: int,
    answer_time: float | None,
    *,
    encrypted: bool = False,
) -> tuple[WorkerLink, dict[str, Any]]:
    connection = _connect(transport, address)
    try:
        prepare_connection(connection)
        connection.settimeout(answer_time)
        connection = encrypt(connection, always=encrypted)
        reader = introduce(connection, token, instance, transport.clock)
        connection.settimeout(None)
    except BaseException:
        connection.close()
        raise
    link = WorkerLink(connection, reader, transport)
    try:
        return link, _receive_setup(link)
    except BaseException:
        link.close()
        raise


def _connect(transport: Transport, address: str) -> Link:
    what = f'No server can be reached at "{address}"'
    advice = "Give the HOST:PORT at which the run listens."
    try:
        return transport.connect(parse_address(address), PATIENCE)
    except (ConfigError, socket.gaierror) as error:
        raise ConnectionRefusedByPeerError(f"{what}: {error} {advice}") from error
    except OSError as error:
        raise UnansweredError(f"{what}: {error}. {advice}") from error


def _receive_setup(link: WorkerLink) -> dict[str, Any]:
    try:
        frame = link.receive()
    except RunEnded:
        raise UnansweredError("The server ended the connection.") from None
    if frame.kind is Kind.ERROR:
        raise decode_error(frame.payload)
    if frame.kind is not Kind.SETUP:
        raise ConnectionRefusedByPeerError(f"The server started with {frame.kind.name}.")
    setup: dict[str, Any] = decode(frame.payload)
    return setup
