"""The messages of the protocol physx: frames, roles, names of arrays, and infos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from physx_core.errors import UsageError
from physx_core.net import encode
from physx_remote.errors import RemoteProtocolError

VERSION = 1
"""Version of the messages after the handshake."""

SERVICE = "physx environments"
"""How a service introduces itself, to distinguish it from the server of a run."""

ACT, OBSERVE = 1, 2
"""Role of a client, sent in the handshake in place of an instance number."""

WORLDS, IS_RESET, COUNT = "worlds", "is_reset", "count"
REWARD, TERMINATED, TRUNCATED = "reward", "terminated", "truncated"
"""Names of the arrays other than observations and actions."""


def encode_infos(infos: Sequence[Mapping[str, Any]]) -> bytes:
    """Return the encodable values of infos as bytes, with the names of the omitted values."""
    left_out: set[str] = set()
    try:
        return encode({"infos": [dict(info) for info in infos], "left_out": []}, "info")
    except UsageError:
        kept = [_encodable(info, left_out) for info in infos]
    return encode({"infos": kept, "left_out": sorted(left_out)}, "info")


def _encodable(info: Mapping[str, Any], left_out: set[str]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in info.items():
        name = str(key)
        if isinstance(value, Mapping):
            found[name] = _encodable(value, left_out)
            continue
        try:
            encode([value], name)
        except UsageError:
            left_out.add(name)
        else:
            found[name] = value
    return found


def split_infos(value: Any, count: int) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the infos of each world, and the names of the omitted values.

    Args:
        value: The decoded result of `encode_infos`.
        count: Number of worlds.
    """
    if isinstance(value, dict):
        infos, left_out = value.get("infos"), value.get("left_out")
        is_named = isinstance(left_out, list) and all(isinstance(name, str) for name in left_out)
        if is_named and isinstance(infos, list) and len(infos) == count:
            return [info if isinstance(info, dict) else {} for info in infos], list(left_out or ())
    raise RemoteProtocolError(f"The other side sent infos that do not match {count} worlds.")
