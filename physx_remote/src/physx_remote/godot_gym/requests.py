"""Requests: how they are cut out of a stream, read and checked."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import Any

from physx_core.errors import RemoteProtocolError, RequestError
from physx_remote.serving.framing import BufferReader

_DECODER = json.JSONDecoder()
_BLANKS = " \t\r\n"
_PARTS = re.compile(rb'["\\{}]')


def parse_request(body: bytes) -> dict[str, Any]:
    """Return a request; an empty body is an empty request.

    Raises:
        RequestError: The body is no object of JSON.
    """
    if not body:
        return {}
    try:
        text = str(body, "utf-8").strip(_BLANKS)
        request, end = _DECODER.raw_decode(text)
        if end != len(text):
            raise ValueError(f"something follows after {end} characters")
    except (ValueError, RecursionError) as error:
        raise RequestError(f"A request of {len(body)} bytes is not valid JSON: {error}.") from None
    if not isinstance(request, dict):
        raise RequestError(
            f'A request is an object of JSON such as {{"reset": 1}}, not {type(request).__name__}.'
        )
    return request


def as_object(key: str, value: Any) -> dict[str, Any]:
    """Return the value of a key that has to be an object.

    Raises:
        RequestError: It is none.
    """
    if not isinstance(value, dict):
        raise RequestError(f'The value of "{key}" is an object of JSON, not {value!r:.60}.')
    return value


def as_count(key: str, value: Any, least: int = 0) -> int:
    """Return how many physics frames or steps are meant.

    Raises:
        RequestError: It is no whole number, or too small.
    """
    if not _is_number(value) or value != int(value) or value < least:
        raise RequestError(f"{key} is a whole number of at least {least}, not {value!r:.60}.")
    return int(value)


def as_seed(value: Any) -> int:
    """Return a seed.

    Raises:
        RequestError: It is no whole number of at least 0.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise RequestError(f"A seed is a whole number of at least 0, not {value!r:.60}.")
    return value


def as_speed(value: Any) -> float | None:
    """Return how much faster than the clock time passes; None for as fast as it can.

    Raises:
        RequestError: It is no number greater than 0.
    """
    if value is None:
        return None
    if not _is_number(value) or value <= 0:
        raise RequestError(
            "time_speed is a number greater than 0, or null for as fast as it can, "
            f"not {value!r:.60}."
        )
    return float(value)


def _is_number(value: Any) -> bool:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and math.isfinite(value)


class JsonReader(BufferReader):
    """Cuts objects of JSON that follow each other without anything that tells their lengths."""

    def __init__(self, limit: int) -> None:
        """Begin in front of an object.

        Args:
            limit: Longest object in bytes that is taken.
        """
        super().__init__()
        self._limit = limit
        self._looked, self._depth = 0, 0
        self._in_text = False

    def take(self) -> bytes | None:
        """Return the next whole object, or None until more has arrived.

        Raises:
            RemoteProtocolError: What has arrived is no object, or one that is too long.
        """
        if self._depth == 0:
            space = len(self.buffer) - len(self.buffer.lstrip())
            del self.buffer[:space]
            if self.buffer and self.buffer[0] != ord("{"):
                raise RemoteProtocolError("The other side sent what is no object of JSON.")
        for end in self._ends():
            if end <= self._limit:
                body = bytes(self.buffer[:end])
                del self.buffer[:end]
                self._looked = 0
                return body
        if len(self.buffer) > self._limit:
            raise RemoteProtocolError(
                f"The other side sent more than the {self._limit} bytes that a request may have."
            )
        return None

    def _ends(self) -> Iterator[int]:
        """Look at what is new; yield where an object ends."""
        while (found := _PARTS.search(self.buffer, self._looked)) is not None:
            mark, end = found.group(), found.end()
            if mark == b"\\":
                if end == len(self.buffer):  # what is escaped has not arrived
                    self._looked = found.start()
                    return
                end += 1
            elif mark == b'"':
                self._in_text = not self._in_text
            elif not self._in_text:
                self._depth += 1 if mark == b"{" else -1
            self._looked = end
            if self._depth == 0:
                yield end
        self._looked = len(self.buffer)
