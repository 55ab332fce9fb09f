"""Parses command-line arguments of the form ``NAME=VALUE``, and references to components."""

from __future__ import annotations

import contextlib
import json
import re
import tomllib
from typing import Any

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

_WORDS = re.compile(r"\[[^][{},\s\"'=]+(\s*,\s*[^][{},\s\"'=]+)*\]")
"""A list of words without brackets, spaces, or quotes."""


def argument_registry() -> ConstructorRegistry:
    """Return tyro's rules for ``NAME=VALUE ...`` and references; a context manager applies them."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def arguments(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        if info.type != dict[str, Any]:
            return None
        return PrimitiveConstructorSpec(
            nargs="*",
            metavar="NAME=VALUE ...",
            instance_from_str=lambda words: dict(_argument(word) for word in words),
            is_instance=lambda value: isinstance(value, dict),
            str_from_instance=lambda value: [f"{name}={item}" for name, item in value.items()],
        )

    @registry.primitive_rule
    def reference(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        if info.type not in (str | type[Any], str | type[Any] | None):
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="REFERENCE",
            instance_from_str=lambda words: None if words[0] == "None" else words[0],
            is_instance=lambda value: True,
            str_from_instance=lambda value: [str(value)],
        )

    return registry


def _argument(word: str) -> tuple[str, Any]:
    """Return the name and value of ``NAME=VALUE``."""
    name, equals, text = word.partition("=")
    if not equals:
        example = "'layers=[3, 32, 2]'"
        raise ValueError(f"{word!r} is not NAME=VALUE; quote it if it has spaces: {example}")
    return name, _value(text)


def _value(text: str) -> Any:
    """Parse a value as TOML, JSON, or a list of bare words; anything else is a string.

    Shells remove quotes: ``["a","b"]`` arrives as ``[a,b]``.
    """
    with contextlib.suppress(ValueError, RecursionError):  # a TOMLDecodeError is a ValueError
        return tomllib.loads(f"value = {text}")["value"]
    with contextlib.suppress(ValueError, RecursionError):
        return json.loads(text)
    if _WORDS.fullmatch(text):
        return [_value(item.strip()) for item in text[1:-1].split(",")]
    return text
