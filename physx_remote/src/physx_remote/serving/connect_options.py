"""The keyword options that clients share, and the check of their names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypedDict

from physx_core.errors import UnknownOptionError


class ConnectOptions(TypedDict, total=False):
    """Options of every client.

    Attributes:
        timeout: How long an answer may take, in s, 60 unless given; None: forever.
        connect_timeout: How long to keep trying to connect, in s, 10 unless given.
        max_answer: Size of the longest accepted answer in bytes, 256 MiB unless given.
    """

    timeout: float | None
    connect_timeout: float
    max_answer: int


class TokenOptions(ConnectOptions, total=False):
    """Options of the clients of the protocol physx.

    Attributes:
        token: The token of the service; None: the content of `token_file`, or without that of the
            environment variable ``PHYSX_TOKEN``.
        token_file: File that holds the token, readable by its owner alone.
    """

    token: str | None
    token_file: str | None


def check_names(owner: str, options: Mapping[str, Any], known: Iterable[str]) -> None:
    """Check that all options are known.

    Args:
        owner: What takes the options, for the error.
        options: The options by name.
        known: The names of the options that `owner` takes.
    """
    names = list(known)
    if not options.keys() <= set(names):
        raise UnknownOptionError(owner, options.keys() - set(names), names)
