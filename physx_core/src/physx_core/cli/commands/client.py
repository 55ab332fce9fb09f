"""``physx client``: join a run that waits for clients, from this or another machine."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from physx_core.cli.options import options_from
from physx_core.errors import ConfigError
from physx_core.net.handshake import TOKEN_VARIABLE
from physx_core.net.tokens import find_token
from physx_core.processes import kill_descendants
from physx_core.workers.client.joining import PATIENCE
from physx_core.workers.client.worker import run_client


@dataclass
class Client:
    """Run one instance of an environment for a run that waits for clients, until the run ends.

    The run has launcher = "physx/manual" and prints its address. The token is in the environment
    variable PHYSX_TOKEN, or in a file that only you can read. Ctrl-C leaves the run; other clients
    simulate an independent episode that this one has begun.
    """

    connect: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Address of the run."""
    instance: int | None = None
    """Number of the instance to run, from 1; by default any instance without a client."""
    token_file: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """File with the token, readable only by you."""
    patience: float = PATIENCE
    """Time in s to keep trying while nothing listens at the address, and to wait for the answer of
    a run that is busy; for the latter at least 10 s."""


def run(words: Sequence[str]) -> None:
    """Run the client and print what it does."""
    options = options_from(Client, words, "client")
    token = find_token(options.token_file)
    if token is None:
        raise ConfigError(
            f"A client needs the run's token: set {TOKEN_VARIABLE}, or name a file that "
            "contains it with --token-file."
        )
    if options.instance is not None and options.instance < 1:
        raise ConfigError(f"--instance is {options.instance}; instances are numbered from 1.")
    os.environ.pop(TOKEN_VARIABLE, None)  # the environment and its processes must not see it
    try:
        status = run_client(
            options.connect,
            token,
            options.instance,
            patience=options.patience,
            answer_time=max(options.patience, PATIENCE),
            say=_say,
        )
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it is already ending
        kill_descendants()
    sys.exit(status)


def _say(text: str) -> None:
    print(f"physx client: {text}", flush=True)
