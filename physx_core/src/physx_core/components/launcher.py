"""Launcher: starts the client processes of a run, here or on other machines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.closeable import Closeable

_POLL_SECONDS = 0.005


class ClientHandle(ABC):
    """A client that a launcher started, with its child processes.

    Attributes:
        instance_id: Number of its instance, from 1.
        clock: The clock that `wait` follows.
    """

    instance_id: int
    clock: Clock = SYSTEM_CLOCK

    @abstractmethod
    def exit_status(self) -> int | None:
        """Return the exit status, negative for a signal; None while the client runs."""

    @abstractmethod
    def terminate(self) -> None:
        """Ask the client and its child processes to end; return immediately."""

    @abstractmethod
    def kill(self) -> None:
        """Kill the client and its child processes."""

    def stderr(self) -> str:
        """Return the last lines of the client's standard error, for messages."""
        return ""

    def state(self) -> str:
        """Return what an unconnected client is waiting for, for messages; empty: unknown."""
        return ""

    def is_queued(self) -> bool:
        """Return whether the client waits for its turn to start; this does not count as silence."""
        return False

    def wait(self, until: float) -> bool:
        """Wait for the client to end; return whether it did before `until`, in monotonic s."""
        while self.exit_status() is None:
            if self.clock.monotonic() >= until:
                return False
            self.clock.sleep(_POLL_SECONDS)
        return True


class Launcher(Closeable):
    """Starts clients; plugins offer their own with the hook ``physx_launchers``.

    The constructor takes the entries of `EnvironmentConfig.launcher_kwargs`. The started processes
    must run ``physx client --connect ADDRESS --instance NUMBER``, with the token in the environment
    variable ``PHYSX_TOKEN`` or in a file that only its owner may read. Do not pass the token on a
    command line: everyone on the machine can read it.

    Attributes:
        by_hand: Whether the user starts the clients. Then the token is one that the user knows, and
            clients may leave and be replaced at any time.
        elsewhere: Whether clients may run on other machines, to which the launcher transfers the
            token. Then the server listens at the address that `open` returns, unless
            `EnvironmentConfig.ip_address` is not the loopback address.
        elastic: Whether the run starts and continues even if some clients are missing; set before
            `open`. Clients for which there is no place yet may wait for one.
    """

    by_hand: bool = False
    elsewhere: bool = False
    elastic: bool = False

    def open(self) -> str | None:
        """Connect to what starts the clients; called once, before the server listens.

        Returns:
            Address of this machine at which clients can reach the server; None: the configured
            one.

        Raises:
            ConfigError: If it cannot be reached.
        """
        return None

    def close(self) -> None:
        """End everything that the launcher started; called after the clients have ended."""

    @abstractmethod
    def launch(self, instances: Sequence[int], address: str, token: str) -> list[ClientHandle]:
        """Start a client for each instance and return immediately.

        Called again, with a single instance, to restart a client.

        Args:
            instances: Numbers of the instances, from 1; if `elastic`, some may join later or never.
            address: ``HOST:PORT`` of the server. If the server listens at all addresses of its
                machine, the host is the one that `open` returned, or else the loopback address.
            token: Secret of the run.

        Returns:
            A handle for each instance; empty if they are started by hand.

        Raises:
            ClientError: If a client cannot be started; those already started are ended.
        """
