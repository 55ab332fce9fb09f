"""Liveness: notices that the machine of a peer is gone, although nobody closed the connection.

A machine that loses its power or its network says nothing. So the system probes an idle connection,
and whoever waits for a peer looks now and then whether it acknowledges what was sent to it. What
counts is the system of the other machine: a peer that computes for minutes, is stopped, or does not
read what arrives, is alive. (Therefore there is no ``TCP_USER_TIMEOUT``: Linux ends with it the
connection of a peer that acknowledges every probe but has no room for more data.)
"""

from __future__ import annotations

import contextlib
import errno
import math
import select
import socket
import struct
import sys
import time

LOOK_EVERY = 2.0
"""How often whoever waits for a peer calls `has_vanished`, in s."""

VANISHED = "its machine no longer answers"
"""What happened to such a peer, for messages."""

_IDLE, _INTERVAL, _PROBES = 5, 3, 3  # s, s: the system gives an idle connection up after 14 s
_SILENCE = 12_000  # ms
_LONGEST_PAUSE = 3_000  # ms between two probes; without this option it doubles, up to two minutes
_TCP_RTO_MAX_MS = 44  # Linux 6.15 or later
_INFO = struct.Struct("=8B13I")  # the beginning of Linux's tcp_info
_LOSSES = {errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ENETDOWN, errno.EHOSTDOWN}


def prepare_connection(connected: socket.socket) -> None:
    """Have the system send small messages at once, and probe the other side when it is idle."""
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


def has_vanished(connected: socket.socket) -> bool:
    """Return whether a peer has acknowledged nothing for 12 s, though it was asked repeatedly.

    Systems other than Linux do not say; they give up after their own times.
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
    """Return whether the system gave a connection up because the other side did not answer."""
    return isinstance(error, OSError) and error.errno in _LOSSES


def poll_peer(poll: select.poll, connected: socket.socket, seconds: float | None) -> bool:
    """Wait for what `poll` watches for on a connection; return whether it came.

    Args:
        poll: Watches the connection.
        connected: The connection.
        seconds: How long to wait, in s; None: as long as the other side's machine answers.

    Raises:
        TimeoutError: If the other side's machine no longer answers; `is_loss` knows it.
    """
    until = math.inf if seconds is None else time.monotonic() + seconds
    while True:
        left = max(0.0, until - time.monotonic())
        if poll.poll(1000 * min(left, LOOK_EVERY)):
            return True
        if has_vanished(connected):
            raise TimeoutError(errno.ETIMEDOUT, VANISHED)
        if left <= LOOK_EVERY:
            return False
