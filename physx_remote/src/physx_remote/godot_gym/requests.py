"""Requests of godot-gym: finding them in a stream, parsing and validation."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import Any

from physx_remote.errors import RemoteProtocolError, RequestError
from physx_remote.serving.framing import BufferReader

_DECODER = json.JSONDecoder()
_BLANKS = " \t\r\n"
_PARTS = re.compile(rb'["\\{}]')


def parse_request(body: bytes) -> dict[str, Any]:
    """Return a request; an empty body is an empty request."""
    if not body:
        return {}
    try:
        text = str(body, "utf-8").strip(_BLANKS)
        request, end = _DECODER.raw_decode(text)
        if end != len(text):
            raise ValueError(f"extra data after {end} characters")
    except (ValueError, RecursionError) as error:
        raise RequestError(f"A request of {len(body)} bytes is not valid JSON: {error}.") from None
    if not isinstance(request, dict):
        raise RequestError(
            f'A request must be a JSON object such as {{"reset": 1}}, not {type(request).__name__}.'
        )
    return request


def as_object(key: str, value: Any) -> dict[str, Any]:
    """Return a value after checking that it is a JSON object."""
    if not isinstance(value, dict):
        raise RequestError(f'The value of "{key}" must be a JSON object, not {value!r:.60}.')
    return value


def as_count(key: str, value: Any, least: int = 0) -> int:
    """Return a number of physics frames or steps, after validating it."""
    if not _is_number(value) or value != int(value) or value < least:
        raise RequestError(f"{key} must be an integer of at least {least}, not {value!r:.60}.")
    return int(value)


def as_seed(value: Any) -> int:
    """Return a seed after validating it."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise RequestError(f"A seed must be a non-negative integer, not {value!r:.60}.")
    return value


def as_speed(value: Any) -> float | None:
    """Return a speed as a multiple of real time, after validating it; None: unlimited."""
    if value is None:
        return None
    if not _is_number(value) or value <= 0:
        raise RequestError(
            "time_speed must be a positive number, or null for as fast as possible, not "
            f"{value!r:.60}."
        )
    return float(value)


def _is_number(value: Any) -> bool:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and math.isfinite(value)


class JsonReader(BufferReader):
    """Splits a stream of JSON objects without length prefixes."""

    def __init__(self, limit: int) -> None:
        """Start before an object.

        Args:
            limit: Size of the longest accepted object in bytes.
        """
        super().__init__()
        self._limit = limit
        self._looked, self._depth = 0, 0
        self._in_text = False

    def take(self) -> bytes | None:
        """Return the next complete object; None if it has not arrived yet."""
        if self._depth == 0:
            space = len(self.buffer) - len(self.buffer.lstrip())
            del self.buffer[:space]
            if self.buffer and self.buffer[0] != ord("{"):
                raise RemoteProtocolError(
                    "The other side sent something that is not a JSON object."
                )
        for end in self._ends():
            if end <= self._limit:
                body = bytes(self.buffer[:end])
                del self.buffer[:end]
                self._looked = 0
                return body
        if len(self.buffer) > self._limit:
            raise RemoteProtocolError(
                f"The other side sent a request of more than {self._limit} bytes."
            )
        return None

    def _ends(self) -> Iterator[int]:
        """Scan new data; yield the end of each object."""
        while (found := _PARTS.search(self.buffer, self._looked)) is not None:
            mark, end = found.group(), found.end()
            if mark == b"\\":
                if end == len(self.buffer):  # the escaped character has not arrived yet
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
