"""Kind: what is done with the objects of a kind, in the graph of what an object holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from physx_core.errors import StateError

Part: TypeAlias = Callable[[Any, str], Any]
"""Returns what stands for a part in a content: atoms themselves, the number of an object as a tuple
``(number,)``. Takes the part and where it is."""
Value: TypeAlias = Callable[[Any], Any]
"""Returns the part that an atom or number stands for."""

PLAIN = "biufcSUmM"
"""Kinds of dtypes that values of any process understand."""


class RefusedError(Exception):
    """Why there can be no state of an object."""


class Kind:
    """What is done with objects of a kind; here: with those that never change.

    Attributes:
        hashes: Whether filling them needs the hash of parts.
    """

    hashes = False

    def read(self, value: Any, part: Part) -> Any:
        """Return the content: a list or dictionary of parts, an array, bytes, or an atom."""
        return getattr(value, "__qualname__", None) or getattr(value, "__name__", str(value))

    def recipe(self, value: Any) -> Any:
        """Return what is needed to make an object, besides its content."""
        raise RefusedError("was added after creation")

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        """Return a new object, empty if `fill` fills it."""
        raise StateError("The state has an object that cannot be made.")

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        """Give an object its content, in place."""
