"""The errors of environments in other processes."""

from __future__ import annotations

from physx_core.errors import PhysxError


class RemoteError(PhysxError):
    """An environment in another process cannot be served, reached or stepped."""


class RemoteClosedError(RemoteError):
    """The connection was closed by either side."""


class RemoteTimeoutError(RemoteError):
    """The other side did not respond in time."""


class RemoteProtocolError(RemoteError):
    """The other side violated the protocol."""


class RequestError(RemoteError):
    """An environment cannot perform a request. It keeps running."""
