"""Tokens: find and check the secret of a run."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from physx_core.config import EnvironmentConfig
from physx_core.errors import ConfigError
from physx_core.net.addresses import is_loopback
from physx_core.net.handshake import TOKEN_VARIABLE

_SHORTEST = 16
_OTHERS = 0o077


def find_token(token_file: str | None, token: str | None = None) -> str | None:
    """Return the user's token, or None if there is none.

    Args:
        token_file: File that holds it; None: it is in the environment variable ``PHYSX_TOKEN``.
        token: The token itself, which takes precedence.

    Raises:
        ConfigError: If the file cannot be read, other users can read it, or the token is too short
            or no text.
    """
    for option, value in (("token", token), ("token_file", token_file)):
        if not isinstance(value, str | os.PathLike | None):
            raise ConfigError(f"{option} is {value!r} but must be text.")
    if token is not None:
        return check_token(token, "token")
    if token_file is None:
        token, place = os.environ.get(TOKEN_VARIABLE), TOKEN_VARIABLE
    else:
        token, place = _read(token_file), token_file
    return None if token is None else check_token(token, place)


def check_token(token: str, place: str) -> str:
    """Return a token after checking that it is long enough.

    Args:
        token: The token.
        place: Where it comes from, for messages.
    """
    if len(token) < _SHORTEST:
        raise ConfigError(
            f"The token in {place} has {len(token)} characters: it must have at least {_SHORTEST}, "
            "so that it cannot be guessed."
        )
    return token


def choose_token(config: EnvironmentConfig, by_hand: bool, elsewhere: bool = False) -> str:
    """Return the token of a run: the user's or a random one.

    Args:
        config: Where the server listens, and the file with the token, if any.
        by_hand: Whether clients are started by hand, by someone who must know the token.
        elsewhere: Whether clients are started on other machines and get the token there.
    """
    token = find_token(config.token_file)
    if token is not None:
        return token
    how = (
        f"set {TOKEN_VARIABLE} (at least {_SHORTEST} characters) for the server and each client, "
        "or write it to a file that only you can read, and pass that file with "
        "EnvironmentConfig.token_file and physx client --token-file."
    )
    if by_hand:
        raise ConfigError(f"Clients that are started by hand need a secret: {how}")
    if not (elsewhere or is_loopback(config.ip_address)):
        raise ConfigError(
            f"Other machines can reach the server at {config.ip_address}, so its clients need a "
            f"secret: {how}"
        )
    return secrets.token_hex(32)


def _read(token_file: str) -> str:
    try:
        with Path(token_file).open(encoding="utf-8") as file:
            mode = os.fstat(file.fileno()).st_mode
            text = "" if mode & _OTHERS else file.read(1 << 16)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"The token file {token_file} cannot be read: {error}.") from error
    if mode & _OTHERS:
        raise ConfigError(
            f"Other users can read or write the token file {token_file}: "
            f"run chmod 600 {token_file}, and choose a new token."
        )
    return text.strip()
