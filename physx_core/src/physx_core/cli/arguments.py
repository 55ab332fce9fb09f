"""Parses the arguments of components: ``NAME=VALUE`` and ``--OPTION.NAME VALUE``.

``--network.network-kwargs width=64 depth=2`` gives all arguments; those that a file or session has
no longer apply. ``--network.network-kwargs.width 64`` changes one, and the others stay.
"""

from __future__ import annotations

import contextlib
import json
import re
import tomllib
from collections.abc import Callable, Sequence
from typing import Any

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from physx_core.errors import UsageError

METAVAR = "NAME=VALUE ..."
"""Stands for the arguments in the help."""
Change = tuple[str, tuple[str, ...], Any]
"""The option ``--OPTION.NAME`` as written, the path of the argument, and its value."""

_REFERENCES = (str | type[Any], str | type[Any] | None, str | Callable[..., Any])
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
            metavar=METAVAR,
            instance_from_str=lambda words: dict(_argument(word) for word in words),
            is_instance=lambda value: isinstance(value, dict),
            str_from_instance=_words_of,
        )

    @registry.primitive_rule
    def reference(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        takes_table = info.type == str | Callable[..., Any] | dict[str, Any] | None
        if not takes_table and info.type not in _REFERENCES:
            return None
        return PrimitiveConstructorSpec(
            nargs="*" if takes_table else 1,
            metavar="REFERENCE|NAME=REFERENCE ..." if takes_table else "REFERENCE",
            instance_from_str=_reference_or_table if takes_table else _reference,
            is_instance=lambda value: True,
            str_from_instance=_words_of,
        )

    @registry.primitive_rule
    def switch_or_table(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        if info.type != bool | dict[str, str]:
            return None
        return PrimitiveConstructorSpec(
            nargs="*",
            metavar="[True|False|NAME=VALUE ...]",
            instance_from_str=lambda words: (
                dict(_argument(word) for word in words)
                if any("=" in word for word in words)
                else bool(_switched(words))
            ),
            is_instance=lambda value: isinstance(value, (bool, dict)),
            str_from_instance=_words_of,
        )

    @registry.primitive_rule
    def switch(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        if info.type != bool | None:
            return None
        return PrimitiveConstructorSpec(
            nargs="*",
            metavar="[True|False]",
            instance_from_str=_switched,
            is_instance=lambda value: value is None or isinstance(value, bool),
            str_from_instance=lambda value: [str(value)],
        )

    return registry


def _words_of(value: Any) -> list[str]:
    if isinstance(value, dict):
        return [f"{name}={item}" for name, item in value.items()]
    return [str(value)]


def _reference(words: Sequence[str]) -> str | None:
    return None if words[0] == "None" else words[0]


def _reference_or_table(words: Sequence[str]) -> str | dict[str, Any] | None:
    is_table = len(words) != 1 or "=" in words[0]
    return dict(_argument(word) for word in words) if is_table else _reference(words)


def _switched(words: Sequence[str]) -> bool | None:
    """Return the value of an option that is on if it is named alone."""
    known = {"True": True, "False": False, "None": None}
    if len(words) > 1 or not known.keys() >= set(words):
        raise ValueError(f"{' '.join(words)!r} is neither True nor False")
    return known[words[0]] if words else True


def take_changes(
    words: Sequence[str], find: Callable[[str], tuple[str, ...] | None]
) -> tuple[list[Change], list[str]]:
    """Return the changes of single arguments, ``--OPTION.NAME VALUE``, and the other words.

    Args:
        words: The words of a command.
        find: Returns the path of the argument that an option names; None: it is no argument.

    Raises:
        UsageError: If a value is missing, or there are several.
    """
    changes: list[Change] = []
    rest: list[str] = []
    left = list(words)
    while left:
        word = left.pop(0)
        option, equals, text = word.partition("=")
        path = find(option) if option.startswith("--") else None
        if path is None:
            rest.append(word)
            continue
        if not equals:
            if not left or left[0].startswith("--"):
                raise UsageError(f"{option} needs a value: {option} VALUE.")
            text = left.pop(0)
        if left and not left[0].startswith("-"):
            raise UsageError(
                f'{option} takes one value, but "{left[0]}" follows. Write a list in brackets, and '
                f"quote it if it has spaces: {option} '[3, 32, 2]'."
            )
        changes.append((option, path, _value(text)))
    return changes, rest


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
