"""Classes by name: objects are made without running any code of their class."""

from __future__ import annotations

import contextlib
import enum
import functools
import sys
from collections.abc import Iterator
from pathlib import PurePath
from types import FunctionType, MemberDescriptorType
from typing import Any

from physx_core.config import SCRIPT_PREFIX
from physx_core.errors import StateError
from physx_core.states.kind import RefusedError


@functools.cache
def slots_of(kind: Any) -> list[str]:
    """Return the names of the slots of a class and its bases."""
    members = [(name, what) for each in kind.__mro__ for name, what in vars(each).items()]
    return [
        name
        for name, what in members
        if isinstance(what, MemberDescriptorType) and name != "__dict__"
    ]


@functools.cache
def cached_of(kind: Any) -> frozenset[str]:
    """Return the names of the cached properties of a class whose objects never change."""
    if not getattr(getattr(kind, "__dataclass_params__", None), "frozen", False):
        return frozenset()
    members = [item for each in kind.__mro__ for item in vars(each).items()]
    return frozenset(n for n, what in members if isinstance(what, functools.cached_property))


@functools.cache
def recipe_of(kind: Any, base: Any) -> str | None:
    """Return the name of a class; None if it is the base itself."""
    if kind is base:
        return None
    name = name_of(kind)
    with contextlib.suppress(TypeError):
        is_found = any(each is kind for each in _classes_named(name, base))
        if is_found and (base is enum.Enum or _made(kind, base) is not None):
            return name
    raise RefusedError("is of a class that cannot be found and made by its name, or has __del__")


def class_named(name: str, base: type[Any]) -> Any:
    """Return a class that is imported, and whose objects run no code when they are made or end.

    Of scripts whose files have the same name, it is that of the last one.

    Raises:
        StateError: If there is none.
    """
    for found in _classes_named(name, base):
        return found
    raise StateError(
        f"The state has an object of {name.replace(':', '.')}, which is not a class of an "
        "imported module, or defines __del__: import it where the environment is defined."
    )


def _classes_named(name: str, base: type[Any]) -> Iterator[Any]:
    module, _, qualified = name.partition(":")
    for found in _modules_named(module):
        for each in qualified.split("."):
            found = vars(found).get(each) if hasattr(found, "__dict__") else None
        if isinstance(found, type) and issubclass(found, base) and not hasattr(found, "__del__"):
            yield found


def new_of(name: str | None, base: Any, *items: Any) -> Any:
    """Return an object of a class by its name, made without any method of that class."""
    return _made(base if name is None else class_named(name, base), base, *items)


def _made(kind: Any, base: Any, *items: Any) -> Any:
    make = base.__new__ if isinstance(kind.__new__, FunctionType) else kind.__new__
    return make(kind, *items)


def class_of(value: Any) -> Any:
    """Return the class of an object, as a value of any type."""
    return type(value)


def name_of(kind: type[Any]) -> str:
    """Return the name by which another process finds a class."""
    return f"{_file_or_module(kind.__module__)}:{kind.__qualname__}"


def _file_or_module(module: str) -> str:
    """Return the name of a module; of a script's file, as its module has many names."""
    file = getattr(sys.modules.get(module), "__file__", None)
    is_script = module == "__main__" or module.startswith(SCRIPT_PREFIX)
    return PurePath(file).name if is_script and file else module


def _modules_named(name: str) -> list[Any]:
    """Return the modules of a name; of scripts of the same name, the last ones first."""
    if name in sys.modules or not name.endswith(".py"):
        return [sys.modules.get(name)]
    names = [each for each in list(sys.modules) if _file_or_module(each) == name]
    return [sys.modules.get(each) for each in reversed(names)]
