"""The keyword options that clients share, and the validation of their names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypedDict

from physx_core.errors import UnknownOptionError


class ConnectOptions(TypedDict, total=False):
    """Options of every client.

    Attributes:
        timeout: Time limit for an answer in s, 60 by default; None: no limit.
        connect_timeout: Time in s to keep trying to connect, 10 by default.
        max_answer: Size of the longest accepted answer in bytes, 256 MiB by default.
    """

    timeout: float | None
    connect_timeout: float
    max_answer: int


class TokenOptions(ConnectOptions, total=False):
    """Options of the clients of the protocol physx.

    Attributes:
        token: The service's token; None: the content of `token_file`, else the environment
            variable ``PHYSX_TOKEN``.
        token_file: File with the token, readable only by its owner.
    """

    token: str | None
    token_file: str | None


def check_names(owner: str, options: Mapping[str, Any], known: Iterable[str]) -> None:
    """Check that all options are known.

    Args:
        owner: What takes the options, for the error message.
        options: The options by name.
        known: The names of the options that `owner` accepts.
    """
    names = list(known)
    if not options.keys() <= set(names):
        raise UnknownOptionError(owner, options.keys() - set(names), names)
