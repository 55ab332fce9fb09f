"""Parses command-line arguments of the form ``NAME=VALUE``, and references to components."""

from __future__ import annotations

import contextlib
import json
import tomllib
from typing import Any

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo


def argument_registry() -> ConstructorRegistry:
    """Return tyro's rules for ``NAME=VALUE ...`` and references; active as a context manager."""
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
    """Return name and value of ``NAME=VALUE``; the value is TOML, or JSON, or else a string."""
    name, equals, text = word.partition("=")
    if not equals:
        raise ValueError(f"{word!r} is not NAME=VALUE")
    with contextlib.suppress(ValueError, RecursionError):  # a TOMLDecodeError is a ValueError
        return name, tomllib.loads(f"value = {text}")["value"]
    with contextlib.suppress(ValueError, RecursionError):
        return name, json.loads(text)
    return name, text
