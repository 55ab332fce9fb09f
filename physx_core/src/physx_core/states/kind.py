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

    def settle(self, node: Any, content: Any, value: Value) -> None:
        """Bring an object into line with its parts, all of which are filled; again afterwards."""


class StateAdapter:
    """How objects of a class in C are captured.

    A package names it in its entry points ``[project.entry-points."physx.states"]`` by the class,
    such as ``"mujoco._structs.MjData" = "package.module:Adapter"``; it is made without arguments.
    """

    def parts(self, value: Any) -> dict[str, Any]:
        """Return all parts of an object that may change, by name, and always the same names.

        Arrays must be the object's own, the same ones at each call: they are filled in place.
        Others are numbers, texts, or objects that states know.
        """
        raise NotImplementedError

    def assign(self, value: Any, parts: dict[str, Any]) -> None:
        """Give an object those of its parts that are numbers or texts."""

    def settle(self, value: Any) -> None:
        """Compute what follows from the parts; the parts themselves are filled again afterwards."""
