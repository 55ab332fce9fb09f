"""Prints what commands found."""

from __future__ import annotations

from physx_core.errors import printable


def show(text: object = "") -> None:
    """Print text with names from files or packages, which must not control the terminal."""
    print(printable(text))
