"""Launcher: what starts the client processes of a run, here or on other machines."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence

_LOOK = 0.005


class ClientHandle(ABC):
    """One client that a launcher started, and all that runs for it.

    Attributes:
        instance_id: Number of the instance that it runs, counted from 1.
    """

    instance_id: int

    @abstractmethod
    def exit_status(self) -> int | None:
        """Return the exit status, negative for a signal; None while the client runs."""

    @abstractmethod
    def terminate(self) -> None:
        """Ask the client and all that it started to end; returns at once."""

    @abstractmethod
    def kill(self) -> None:
        """End the client and all that it started, whether they want to or not."""

    def stderr(self) -> str:
        """Return the last lines that the client wrote to its standard error, for messages."""
        return ""

    def wait(self, until: float) -> bool:
        """Wait for the client's end; return whether it came before `until`, in monotonic s."""
        while self.exit_status() is None:
            if time.monotonic() >= until:
                return False
            time.sleep(_LOOK)
        return True


class Launcher(ABC):
    """Starts clients; a plugin offers its own with the hook ``physx_launchers``.

    The constructor takes the entries of `EnvironmentConfig.launcher_kwargs`. Whatever it starts has
    to end up in ``physx client --connect ADDRESS --instance NUMBER``, with the token in the
    environment variable ``PHYSX_TOKEN`` or in a file that only its owner may read; a command line
    is no place for the token, for everybody on the machine can read it.

    Attributes:
        by_hand: Whether people start the clients. Then the token is one that they know, and a
            client may leave and another take its place at any time.
    """

    by_hand: bool = False

    @abstractmethod
    def launch(self, instances: Sequence[int], address: str, token: str) -> list[ClientHandle]:
        """Start a client for each instance and return at once.

        Called again, with a single instance, where a client is started again.

        Args:
            instances: Numbers of the instances, counted from 1.
            address: ``HOST:PORT`` at which the server listens. Where it listens at all addresses
                of its machine, the host is the loopback address: clients elsewhere need the
                machine's own.
            token: Secret of the run.

        Returns:
            A handle for each instance; nothing where they are started by hand.

        Raises:
            ClientError: A client cannot be started; none that was is left behind.
        """
