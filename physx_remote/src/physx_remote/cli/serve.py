"""``physx serve``: serve an environment to Godot clients, trainers, and physx."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from physx_core.cli import options_from
from physx_core.errors import ConfigError, UsageError
from physx_core.net import TOKEN_VARIABLE
from physx_core.processes import TemporaryFolder
from physx_remote.endpoints import serve
from physx_remote.godot_rl.launch import write_launcher
from physx_remote.serving.service import LOG, Service, poll_until_interrupted

_PORTS = {"godot-gym": 9090, "godot-rl": 0, "physx": 0}
_WITH_TOKEN = "physx"
_WITH_LAUNCHER = "godot-rl"


@dataclass
class Serve:
    """Serve an environment to other processes, until Ctrl-C.

    Clients of the protocol physx need a token: the content of --token-file, which is created if it
    does not exist, else the environment variable PHYSX_TOKEN, else a new file that is removed at
    the end.
    """

    environment: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENVIRONMENT")]
    """"physx/Cartpole-v0", "gym/CartPole-v1", "dart/arm", "module:id-v0", "script.py:Class" ..."""
    protocol: str = "physx"
    """"physx", "godot-gym", "godot-rl", or "package.module:Class"."""
    address: str = "127.0.0.1"
    """Address to listen at; for godot-rl, the trainer's address."""
    port: int | None = None
    """Port; by default 9090 for godot-gym, the trainer's 11008 for godot-rl, else any free one."""
    num_worlds: int = 1
    """Number of worlds to serve on one connection."""
    token_file: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File with the token of the protocol physx, readable only by its owner."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Arguments of the environment."""
    options: dict[str, Any] = field(default_factory=dict)
    """The protocol's own options, for example clients=serve for godot-gym."""
    write_launcher: Annotated[Path | None, tyro.conf.arg(metavar="FILE.x86_64")] = None
    """Only for godot-rl: write a launcher file for the trainer's env_path, and exit."""


def run(words: Sequence[str]) -> None:
    """Run the command."""
    chosen = options_from(Serve, words, "serve")
    if chosen.write_launcher is not None:
        _write_launcher(chosen)
        return
    with contextlib.ExitStack() as stack:
        stack.enter_context(_printed_log())
        options = dict(chosen.options)
        if chosen.protocol == _WITH_TOKEN:
            options["token_file"] = stack.enter_context(_token_file(chosen.token_file))
        elif chosen.token_file is not None:
            raise UsageError(f'--token-file is for the protocol "{_WITH_TOKEN}".')
        port = _PORTS.get(chosen.protocol, 0) if chosen.port is None else chosen.port
        service = stack.enter_context(
            serve(
                chosen.environment,
                chosen.protocol,
                address=chosen.address,
                port=port,
                num_worlds=chosen.num_worlds,
                env_kwargs=chosen.env_kwargs,
                **options,
            )
        )
        _print_address(chosen, service, options.get("token_file"))
        poll_until_interrupted(service.poll)


@contextlib.contextmanager
def _printed_log() -> Iterator[None]:
    """Print the log of the services."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("physx serve: %(message)s"))
    before = LOG.level
    LOG.addHandler(handler)
    LOG.setLevel(logging.INFO)
    try:
        yield
    finally:
        LOG.removeHandler(handler)
        LOG.setLevel(before)


def _print_address(chosen: Serve, service: Service, token_file: str | None) -> None:
    host, port = service.address
    verb = "connected to" if chosen.protocol == _WITH_LAUNCHER else "listening at"
    print(f"{chosen.environment} over {chosen.protocol}, {verb} {host}:{port}", flush=True)
    if chosen.protocol == _WITH_TOKEN:
        place = token_file or f"the environment variable {TOKEN_VARIABLE}"
        print(f"token: {place}", flush=True)
        given = f', token_file="{token_file}"' if token_file else ""
        print(f'  physx_remote.connect("{host}:{port}"{given})', flush=True)
    print("Press Ctrl-C to stop.", flush=True)


@contextlib.contextmanager
def _token_file(given: Path | None) -> Iterator[str | None]:
    """Yield the file with the token, None if it is in the environment; remove a generated file."""
    if given is None and TOKEN_VARIABLE in os.environ:
        yield None
    elif given is not None:
        try:
            with contextlib.suppress(FileExistsError):
                _write_token(given)
        except OSError as error:
            raise ConfigError(f"The token file {given} cannot be written: {error}.") from error
        yield str(given.absolute())
    else:
        with TemporaryFolder("token-") as made:
            place = made.path / "token"
            _write_token(place)
            yield str(place)


def _write_token(path: Path) -> None:
    """Write a new token to a new file that only its owner can read."""
    opened = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(opened, "w", encoding="ascii") as file:
        file.write(secrets.token_hex(32) + "\n")


def _write_launcher(chosen: Serve) -> None:
    if chosen.protocol != _WITH_LAUNCHER:
        raise UsageError(
            f"--write-launcher is for trainers of godot-rl: add --protocol {_WITH_LAUNCHER}."
        )
    if chosen.options.keys() - {"action_repeat"}:
        raise UsageError("A launcher only supports the option action_repeat.")
    path = write_launcher(
        chosen.write_launcher or "",
        chosen.environment,
        num_worlds=chosen.num_worlds,
        env_kwargs=chosen.env_kwargs,
        **chosen.options,
    )
    print(f'{path}\n  GodotEnv(env_path="{path}") starts it.')
