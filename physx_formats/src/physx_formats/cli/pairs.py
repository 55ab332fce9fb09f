"""Options whose words are NAME=VALUE."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.errors import UsageError


def parse_pairs(option: str, words: Sequence[str]) -> dict[str, str]:
    """Return values by name.

    Args:
        option: Name of the option, for the message.
        words: Its words, such as ``speed=m/s``.

    Raises:
        UsageError: If a word has no name or no value.
    """
    found = {}
    for word in words:
        name, is_given, text = word.partition("=")
        if not (name and is_given):
            raise UsageError(f"--{option} {word} names no value: write NAME=VALUE.")
        found[name] = text
    return found
