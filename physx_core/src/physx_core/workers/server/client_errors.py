"""Builds the errors for clients that exited or timed out."""

from __future__ import annotations

from physx_core.components.launcher import ClientHandle
from physx_core.errors import ClientError
from physx_core.net.liveness import VANISHED
from physx_core.processes import describe_exit
from physx_core.workers.server.peer import Peer

_LINES_TIME = 0.1  # for the last lines of its standard error to arrive
_LAST_WORDS_TIME = 0.3  # for a hung client to write where it hangs
_LEAVE_TIME = 0.8  # a process that loses its connection exits a little later


def exit_error(number: int, peer: Peer | None, handle: ClientHandle | None) -> ClientError:
    """Return the error for a client that is gone.

    Args:
        number: Its instance.
        peer: Its connection; None: it has not connected yet.
        handle: Its process; None if it was started by hand.
    """
    if peer is not None and peer.violation:
        if handle is not None:
            handle.wait(handle.clock.monotonic() + _LINES_TIME)
        stderr = "" if handle is None else handle.stderr()
        what = f"was cut off after {peer.received} rows. {peer.violation}"
        return ClientError(number, what, stderr=stderr)
    made = 0 if peer is None else peer.received
    when = "before it connected" if peer is None else f"after {made} rows"
    if peer is not None and peer.has_vanished:
        return ClientError(number, f"was lost {when}: {VANISHED}.")
    if handle is None:
        return ClientError(number, f"closed the connection {when}. Its own terminal may say why.")
    handle.wait(handle.clock.monotonic() + _LEAVE_TIME)
    status = handle.exit_status()
    how = "closed the connection" if status is None else describe_exit(status)
    return ClientError(
        number,
        f"{how} {when}. To see what it does, run it in this process: as_tcp_ip_client=False "
        "(--environment.no-as-tcp-ip-client).",
        exit_status=status,
        stderr=handle.stderr(),
    )


def timeout_error(
    number: int,
    peer: Peer | None,
    handle: ClientHandle | None,
    timeout: float,
) -> ClientError:
    """Return the error for a client that kept the server waiting too long.

    Args:
        number: Its instance.
        peer: Its current or last connection; None: it has not connected.
        handle: Its process; None if it was started by hand.
        timeout: How long the server waited, in s.
    """
    state = "" if handle is None else handle.state()
    waited = f"for {timeout:g} s while the server waited for it" + (state and f": {state}")
    if peer is None:
        how = f"did not connect {waited}. If its start takes"
    elif peer.vacant:
        lost = f"was lost after {peer.received} rows"
        how = f"{lost}, and no other took its place {waited}. If a start takes"
    else:
        how = f"sent nothing {waited}. If its steps take"
    text = f"{how} that long, raise EnvironmentConfig.timeout."
    return ClientError(number, text, stderr=_last_words(handle))


def overdue_error(
    number: int, handle: ClientHandle | None, episode: int, seconds: float
) -> ClientError:
    """Return the error for a client whose episode takes too long.

    Args:
        number: Its instance.
        handle: Its process; None if it was started by hand.
        episode: Number of the episode.
        seconds: How long it has simulated this, in s.
    """
    text = (
        f"has simulated episode {episode} for {seconds:.3g} s. If it takes that long, raise "
        "EnvironmentConfig.episode_timeout."
    )
    return ClientError(number, text, stderr=_last_words(handle))


def _last_words(handle: ClientHandle | None) -> str:
    """Make a client end, and return the last lines of its standard error: where it hung."""
    if handle is None:
        return ""
    handle.terminate()
    handle.wait(handle.clock.monotonic() + _LAST_WORDS_TIME)
    return handle.stderr()
