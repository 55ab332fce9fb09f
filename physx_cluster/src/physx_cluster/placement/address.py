"""Addresses at which other machines reach this one."""

from __future__ import annotations

import socket

from physx_core.errors import ConfigError


def address_towards(host: str) -> str:
    """Return the address of the interface through which this machine reaches another one.

    Nothing is sent; the kernel is asked for the route.

    Args:
        host: Name or address of the other machine.

    Raises:
        ConfigError: If there is no route to it.
    """
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, 9, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.connect(place)
            return str(probe.getsockname()[0])
    except OSError as error:
        raise ConfigError(
            f"No interface of this machine reaches {host}: {error}. Set the address at which the "
            "nodes reach this machine with EnvironmentConfig.ip_address."
        ) from error
