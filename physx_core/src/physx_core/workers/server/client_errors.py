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


def exit_error(
    number: int, peer: Peer | None, handle: ClientHandle | None, place: str = ""
) -> ClientError:
    """Return the error for a client that is gone.

    Args:
        number: Its instance.
        peer: Its connection; None: it has not connected yet.
        handle: Its process; None if it was started by hand.
        place: In an elastic run, the client that ran the instance, and its machine.
    """
    if peer is not None and peer.offense:
        if handle is not None:
            handle.wait(handle.clock.monotonic() + _LINES_TIME)
        stderr = "" if handle is None else handle.stderr()
        what = f"was cut off after {peer.received} rows. {peer.offense}"
        return ClientError(number, what, stderr=stderr, client=place)
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
        client=place,
    )


def timeout_error(
    number: int,
    peer: Peer | None,
    handle: ClientHandle | None,
    timeout: float,
    place: str = "",
) -> ClientError:
    """Return the error for a client that kept the server waiting too long.

    Args:
        number: Its instance.
        peer: Its current or last connection; None: it has not connected.
        handle: Its process; None if it was started by hand.
        timeout: How long the server waited, in s.
        place: In an elastic run, the client that ran the instance, and its machine.
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
    if handle is not None:
        handle.terminate()  # it writes where it hung
        handle.wait(handle.clock.monotonic() + _LAST_WORDS_TIME)
    return ClientError(
        number,
        f"{how} that long, raise EnvironmentConfig.timeout.",
        client=place,
        stderr="" if handle is None else handle.stderr(),
    )
