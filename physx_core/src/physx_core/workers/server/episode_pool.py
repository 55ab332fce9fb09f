"""EpisodePool: what a run of independent episodes does about clients that are lost or too few."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection

from physx_core.clock import Clock
from physx_core.components.launcher import ClientHandle
from physx_core.config import EnvironmentConfig
from physx_core.errors import ConfigError, PhysxError, TooFewClientsError
from physx_core.workers.launchers import describe_states
from physx_core.workers.server.leases import Leases
from physx_core.workers.server.peer import Peer

_SAY_EVERY = 5.0
_IDLE_LOSSES = 3  # in a row at the same place; then something is wrong there
_LOG = logging.getLogger("physx")


class EpisodePool:
    """Clients of which any can simulate any episode; they may join and leave.

    Attributes:
        least: How many clients there must be.
        is_open: Whether others who know the token may start clients, besides the launcher.
        is_ending: Whether no other client is needed.
        leases: The episodes that they simulate; None before the first one is ready.
    """

    is_ending = False

    def __init__(self, config: EnvironmentConfig, clock: Clock, *, is_open: bool) -> None:
        """Begin without clients.

        Args:
            config: How many clients there may be, and how long the run waits for them.
            clock: Tells how long there have been too few.
            is_open: Whether others who know the token may start clients, besides the launcher.

        Raises:
            ConfigError: If more clients are needed or started than there may be.
        """
        self.least, self.is_open = config.min_clients or 1, is_open
        self.leases: Leases | None = None
        self._config, self._clock = config, clock
        self._idle_losses: Counter[int] = Counter()
        self._short_since: float | None = None
        self._said = 0.0
        self._lost = ""
        for option, count in (("min_clients", self.least), ("num_clients", config.num_clients)):
            if count > config.places:
                raise ConfigError(
                    f"EnvironmentConfig.{option} is {count}, but there may be at most "
                    f"{config.places} clients: raise max_clients."
                )

    def adopt(self, peer: Peer) -> None:
        """Do nothing: a client begins without what earlier ones have left."""

    def close(self) -> None:
        """Do nothing: there is nothing to forget."""

    def replaces(self, number: int, error: PhysxError | None) -> bool:
        """Return False: no client goes on where another one ended."""
        return False

    def lose(self, number: int, error: PhysxError, peer: Peer | None, *, launched: bool) -> bool:
        """Give the episodes of a client that is lost, or leaves, back, and log what follows.

        Args:
            number: Its place.
            error: How it was lost.
            peer: Its connection; None: it has none.
            launched: Whether the launcher started it.

        Returns:
            Whether the launcher should start another one.

        Raises:
            PhysxError: If another one would likely end in the same way.
        """
        if peer is not None and peer.has_left:
            self._leave(number)
            return False
        again, ready = launched, peer is not None and bool(peer.fields)
        if launched and not ready and not self._config.is_elastic:
            raise error
        holds = self.leases is not None and number in self.leases.holders
        self._idle_losses[number] = 0 if holds else self._idle_losses[number] + 1
        if launched and self._idle_losses[number] > _IDLE_LOSSES:
            if not self._config.is_elastic:
                raise error
            again = False
        text, _, details = str(error).partition("\n")
        follows = self._give_back(number, text) if holds else "It had no episode."
        if not again and launched:
            follows += " It is not replaced."
        self._lost = text
        _LOG.warning("%s. %s%s", text.rstrip("."), follows, details and "\n" + details)
        return again

    def _leave(self, number: int) -> None:
        """Give the episodes of a client that leaves to others."""
        if self.leases is not None:
            self.leases.release(number)
        self._lost = f"Client {number} left."
        _LOG.info("Client %d left the run.", number)

    def check_count(
        self, ready: Collection[int], absent: Collection[ClientHandle], served_since: float
    ) -> None:
        """Report from time to time that there are too few clients, and end the run after a while.

        Args:
            ready: The clients whose environments are ready.
            absent: Those that the launcher started and that have not joined yet.
            served_since: Since when the run has listened to its clients, in monotonic s.

        Raises:
            TooFewClientsError: If there have been too few for too long, or no other can join.
        """
        now, count = self._clock.monotonic(), len(ready)
        if count >= self.least:
            self._short_since = None
            return
        queued = any(handle.is_queued() for handle in absent)
        if self._short_since is None:
            self._short_since = now
        waited = now - max(self._short_since, served_since)
        is_closed = not self.is_open and count + len(absent) < self.least
        if is_closed or (waited > self._config.timeout and not queued):
            what = "no more can join" if is_closed else f"no other joined for {waited:.0f} s"
            raise TooFewClientsError(
                count,
                self.least,
                f"The run has {_count(count)}, but needs {self.least} (min_clients), and {what}. "
                f"{self._lost.rstrip('.') or 'None was lost'}. If clients need longer to start, "
                "raise EnvironmentConfig.timeout.",
            )
        if waited > _SAY_EVERY and now - self._said > _SAY_EVERY:
            self._said = now
            _LOG.warning(
                "The run has %s and has been waiting for others for %.0f s%s. It needs %d "
                "(min_clients), and waits no longer than %g s.",
                _count(count),
                waited,
                describe_states(absent),
                self.least,
                self._config.timeout,
            )

    def find_overdue(self) -> list[tuple[int, int, float]]:
        """Return the clients whose episode has taken too long: see `Leases.simulated`."""
        limit = self._config.episode_timeout
        if self.leases is None or limit is None:
            return []
        return [each for each in self.leases.simulated() if each[2] > limit]

    def _give_back(self, number: int, reason: str) -> str:
        """Give a lost client's episodes back; return what follows."""
        assert self.leases is not None
        failed = self.leases.lose(number)
        if failed is None:
            return "Its episode is simulated once more."
        self.leases.fail(failed, reason)
        return f"Episode {failed} has failed."


def _count(count: int) -> str:
    return f"{count} client{'s' if count != 1 else ''}"
