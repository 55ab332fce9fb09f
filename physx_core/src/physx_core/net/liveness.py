"""Liveness: detects that a peer's machine is gone although the connection was not closed.

A machine that loses power or network sends nothing. Therefore, the operating system probes idle
connections, and code that waits for a peer periodically checks whether it acknowledges data. Only
the peer's operating system counts: a peer that computes for minutes, is stopped, or does not read
its data is alive. (``TCP_USER_TIMEOUT`` is not used for this reason: with it, Linux ends the
connection to a peer that acknowledges every probe but has no room for more data.)
"""

from __future__ import annotations

import contextlib
import errno
import math
import socket
import struct
import sys

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.net.link import Link, Poll

CHECK_INTERVAL = 2.0
"""Interval at which code that waits for a peer calls `has_vanished`, in s."""

VANISHED = "its machine no longer answers"
"""Reason why such a peer was lost, for messages."""

_IDLE, _INTERVAL, _PROBES = 5, 3, 3  # s, s: the system gives up an idle connection after 14 s
_SILENCE = 12_000  # ms
_LONGEST_PAUSE = 3_000  # ms between two probes; without this option it doubles up to two minutes
_TCP_RTO_MAX_MS = 44  # Linux 6.15 or later
_INFO = struct.Struct("=8B13I")  # beginning of Linux's tcp_info
_LOSSES = {errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ENETDOWN, errno.EHOSTDOWN}


def prepare_connection(connected: Link) -> None:
    """Make the system send small messages immediately and probe the peer when idle."""
    options = [(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)]
    idle = getattr(socket, "TCP_KEEPIDLE", getattr(socket, "TCP_KEEPALIVE", None))
    for option, value in (
        (idle, _IDLE),
        (getattr(socket, "TCP_KEEPINTVL", None), _INTERVAL),
        (getattr(socket, "TCP_KEEPCNT", None), _PROBES),
        (_TCP_RTO_MAX_MS if sys.platform == "linux" else None, _LONGEST_PAUSE),
    ):
        if option is not None:
            options.append((socket.IPPROTO_TCP, option, value))
    for level, option, value in (*options, (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)):
        with contextlib.suppress(OSError):  # not TCP, or a system that lacks the option
            connected.setsockopt(level, option, value)


def has_vanished(connected: Link) -> bool:
    """Return whether a peer has acknowledged nothing for 12 s despite repeated probes.

    Only Linux provides this information; other systems give up after their own timeouts.
    """
    option = getattr(socket, "TCP_INFO", None)
    if option is None:
        return False
    try:
        info = _INFO.unpack(connected.getsockopt(socket.IPPROTO_TCP, option, _INFO.size))
    except (OSError, struct.error):  # not TCP, or closed
        return False
    retransmissions, probes = info[2:4]
    silence = min(info[19:21])  # ms since data arrived, and since an acknowledgment did
    return bool(max(retransmissions, probes) > 1 and silence > _SILENCE)


def is_loss(error: BaseException | None) -> bool:
    """Return whether the system gave up a connection because the peer did not answer."""
    return isinstance(error, OSError) and error.errno in _LOSSES


def poll_peer(
    poll: Poll, connected: Link, seconds: float | None, clock: Clock = SYSTEM_CLOCK
) -> bool:
    """Wait for the events of `poll` on a connection; return whether one occurred.

    Args:
        poll: Watches the connection.
        connected: The connection.
        seconds: How long to wait, in s; None: as long as the peer's machine answers.
        clock: The clock that it follows.

    Raises:
        TimeoutError: If the peer's machine no longer answers; `is_loss` recognizes the error.
    """
    until = math.inf if seconds is None else clock.monotonic() + seconds
    while True:
        left = max(0.0, until - clock.monotonic())
        if poll.poll(1000 * min(left, CHECK_INTERVAL)):
            return True
        if has_vanished(connected):
            raise TimeoutError(errno.ETIMEDOUT, VANISHED)
        if left <= CHECK_INTERVAL:
            return False
