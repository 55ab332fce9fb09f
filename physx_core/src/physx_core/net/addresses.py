"""Network addresses: parsing, formatting and checking them, and trying to reach one for a while."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

from physx_core.errors import ConfigError

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


def retry(
    attempt: Callable[[float], Reached],
    patience: float,
    pause: float,
    *errors: type[Exception],
) -> Reached:
    """Return what an attempt returns, and repeat it as long as it fails.

    Args:
        attempt: Called with the time in s that it may take.
        patience: How long to go on, in s.
        pause: Time between two attempts, in s.
        errors: Errors after which to try again; the last one is raised in the end.
    """
    until = time.monotonic() + patience
    while True:
        try:
            return attempt(max(until - time.monotonic(), pause))
        except errors:
            if time.monotonic() + pause > until:
                raise
        time.sleep(pause)
