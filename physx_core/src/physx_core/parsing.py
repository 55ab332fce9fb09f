"""Parses untrusted JSON and TOML within limits of size and depth."""

from __future__ import annotations

import json
import re
from typing import Any

_MOST_CONTAINERS = 2**20
_MOST_ITEMS = 2**23
_MOST_PARTS = 64
_LONG_KEY = re.compile(rb"(?:\A|[\n=\[\]{},])(?:[^\n=\[\]{},.]*+\.){%d}" % (_MOST_PARTS + 1))


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: If it is not JSON, is nested too deeply, or has so many parts that they would
            take far more memory than the text.
    """
    content = text.encode() if isinstance(text, str) else text
    if content.count(b"[") + content.count(b"{") > _MOST_CONTAINERS:
        raise ValueError(f"it has more than {_MOST_CONTAINERS} lists and objects")
    if content.count(b",") > _MOST_ITEMS:
        raise ValueError(f"it has more than {_MOST_ITEMS} items")
    try:
        return json.loads(content)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def parse_toml(content: bytes) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Raises:
        ValueError: If it is not TOML, or is nested too deeply.
    """
    import tomllib

    if _LONG_KEY.search(content.translate(None, b" \t")):  # parsing it takes quadratic time
        raise ValueError(f"a key has more than {_MOST_PARTS} parts, or a string as many dots")
    try:
        return tomllib.loads(content.decode())
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
