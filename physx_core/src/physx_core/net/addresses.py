"""Network addresses: parsing, formatting and checking them, and retrying to reach one."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Callable
from typing import Any, TypeVar

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.errors import ConfigError
from physx_core.net.link import Link

Reached = TypeVar("Reached")

_LAST_PORT = 0xFFFF


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of ``"host:port"`` or ``"[::1]:port"``.

    Raises:
        ConfigError: If the text does not have this form.
    """
    host, _, port = text.rpartition(":") if isinstance(text, str) else ("", "", "")
    if not host or not port.isdecimal() or int(port) > _LAST_PORT:
        raise ConfigError(
            f'{text!r} is not a valid address: give "host:port", such as "127.0.0.1:9090".'
        )
    return host.strip("[]"), int(port)


def format_address(host: str, port: int) -> str:
    """Return ``"host:port"``, or ``"[::1]:port"`` for an IPv6 address."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def check_address(address: Any, port: Any) -> None:
    """Check that an address and a port have the right types, and that the port is in range.

    Raises:
        ConfigError: If either is invalid.
    """
    if not isinstance(address, str) or not address:
        raise ConfigError(f'address is {address!r} but must be a string such as "127.0.0.1".')
    if type(port) is not int or not 0 <= port <= _LAST_PORT:
        raise ConfigError(f"port is {port!r} but must be an integer from 0 to {_LAST_PORT}.")


def is_loopback(host: str) -> bool:
    """Return whether a server at an address can be reached only from its own machine."""
    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
        places = [ipaddress.ip_address(entry[4][0]) for entry in found]
    except (OSError, ValueError):  # the code that uses the address reports the problem
        return False
    return all((getattr(one, "ipv4_mapped", None) or one).is_loopback for one in places)


def is_same_host(connection: Link) -> bool:
    """Return whether the peer is on this machine, judging by its address."""
    if connection.family not in (socket.AF_INET, socket.AF_INET6):
        return True
    try:
        return is_loopback(connection.getpeername()[0])
    except OSError:  # it is gone
        return False


def retry(
    attempt: Callable[[float], Reached],
    patience: float,
    pause: float,
    *errors: type[Exception],
    clock: Clock = SYSTEM_CLOCK,
) -> Reached:
    """Repeat an attempt until it succeeds, and return its result.

    Args:
        attempt: Called with the time in s that it may take.
        patience: How long to keep trying, in s.
        pause: Time between two attempts, in s.
        errors: Errors after which to try again; when time is up, the last one is raised.
        clock: The clock that it follows.
    """
    until = clock.monotonic() + patience
    while True:
        try:
            return attempt(max(until - clock.monotonic(), pause))
        except errors:
            if clock.monotonic() + pause > until:
                raise
        clock.sleep(pause)
