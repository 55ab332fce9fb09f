"""Encodes physx errors as plain values and decodes them to the same classes."""

from __future__ import annotations

import importlib
import traceback
from typing import Any

from physx_core.errors import ConnectionRefusedByPeerError, PhysxError, UsageError
from physx_core.net.values import decode, encode
from physx_core.plugins.entries import official_modules

_PARTS = {"classes": list, "message": str, "attributes": dict, "traceback": str}


class RemoteTraceback(Exception):  # noqa: N818 - it is the cause of an error, not an error itself
    """The traceback of an error as text, from the process that raised it."""

    def __str__(self) -> str:
        """Return the text, starting on a new line."""
        return f"\n{self.args[0]}"


def encode_error(error: PhysxError) -> bytes:
    """Return an error with its attributes, notes and traceback as bytes."""
    attributes = {name: kept for name, kept in vars(error).items() if _is_plain(kept)}
    return encode(
        {
            "classes": [f"{cls.__module__}:{cls.__name__}" for cls in type(error).__mro__],
            "message": str(error),
            "attributes": attributes,
            "traceback": "".join(traceback.format_exception(error)),
        }
    )


def decode_error(payload: bytes | bytearray) -> PhysxError:
    """Return the error that was given to `encode_error`.

    Its class is looked up in `physx_core.errors` and the ``errors`` of physx's other packages only;
    any other error class is replaced by the nearest of these that it derives from.

    Raises:
        ConnectionRefusedByPeerError: If the bytes do not describe an error.
    """
    plain: dict[str, Any] = decode(payload)
    if not _is_error(plain):
        raise ConnectionRefusedByPeerError("A received error message does not describe an error.")
    cls = next((c for c in map(_error_class, plain["classes"]) if c is not None), PhysxError)
    error = cls.__new__(cls)
    Exception.__init__(error, plain["message"])
    vars(error).update(plain["attributes"])
    error.__cause__ = RemoteTraceback(plain["traceback"])
    return error


def _error_class(name: str) -> type[PhysxError] | None:
    place, _, attribute = name.partition(":")
    package, _, module = place.rpartition(".")
    if module != "errors" or package not in {"physx_core", *official_modules()}:
        return None
    try:
        found = getattr(importlib.import_module(place), attribute, None)
    except ImportError:  # this process does not have the package
        return None
    return found if isinstance(found, type) and issubclass(found, PhysxError) else None


def _is_error(plain: Any) -> bool:
    if not isinstance(plain, dict) or {k: type(value) for k, value in plain.items()} != _PARTS:
        return False
    notes = plain["attributes"].get("__notes__", [])
    texts = [*plain["classes"], *plain["attributes"], *(notes if type(notes) is list else [None])]
    return all(type(text) is str for text in texts)


def _is_plain(value: Any) -> bool:
    try:
        encode(value)
    except UsageError:
        return False
    return True
