"""The kinds of components: the core's, and those that installed packages add."""

from __future__ import annotations

import functools
import importlib
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING

from physx_core.errors import PluginError, ReferenceFormError
from physx_core.origin import install_hint
from physx_core.plugins import hookspecs
from physx_core.plugins.entries import (
    HOOKSPECS,
    describe_conflict,
    find_entries,
    official_package,
    owner_of,
)
from physx_core.plugins.loading import loading

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@dataclass(frozen=True)
class Kind:
    """A kind of component.

    Attributes:
        name: Its name, such as ``network``.
        base: Reference of its base class, ``"package.module:Class"``.
        is_instance: Whether `resolve` returns an instance of the class, made without arguments.
    """

    name: str
    base: str
    is_instance: bool = False


def hook_of(kind: str) -> str:
    """Return the name of the hook that returns components of a kind."""
    return f"physx_{kind}s"


def kind_of(hook: str) -> str:
    """Return the kind of the components that a hook returns."""
    return hook.removeprefix("physx_").removesuffix("s")


def _kinds_in(module: ModuleType) -> dict[str, Kind]:
    marks = {name: getattr(hook, hookspecs.MARK, None) for name, hook in vars(module).items()}
    return {kind_of(hook): Kind(kind_of(hook), *mark) for hook, mark in marks.items() if mark}


CORE_KINDS = _kinds_in(hookspecs)
"""The kinds that the core brings, by name."""


def kind_names() -> list[str]:
    """Return the names of all kinds, from metadata only."""
    return [*CORE_KINDS, *sorted(set(map(kind_of, find_entries(HOOKSPECS))) - set(CORE_KINDS))]


def find_kind(name: str) -> Kind:
    """Return a kind by name; those of the core without reading metadata.

    Raises:
        ReferenceFormError: If there is none.
        PluginError: If the package that brings it is broken.
    """
    if name in CORE_KINDS:
        return CORE_KINDS[name]
    hook = hook_of(name)
    if hook not in find_entries(HOOKSPECS):
        package = official_package(hook, HOOKSPECS)
        raise ReferenceFormError(
            f'"{name}" is not a kind of component: {", ".join(kind_names())}.'
            + (f" It is one of {package}. {install_hint(package)}" if package else "")
        )
    return _kinds_in(hookspecs_of(hook))[name]


def further_hooks() -> list[str]:
    """Return the names of the hooks that installed packages add, from metadata only."""
    return list(find_entries(HOOKSPECS))


def hookspecs_of(hook: str) -> ModuleType:
    """Import the module that specifies a hook.

    Raises:
        PluginError: If the package is broken, or several bring this hook.
    """
    entries = find_entries(HOOKSPECS)[hook]
    if len(entries) > 1:
        raise PluginError(hook, describe_conflict("hook", entries))
    return _load(hook, entries[0])


@functools.cache
def _load(hook: str, entry: EntryPoint) -> ModuleType:
    """Import the module once: `resolve` asks for a kind several times."""
    with loading(
        hook, f"The hook {hook} ({owner_of(entry)})", f"cannot be read from {entry.value}"
    ):
        module = importlib.import_module(entry.value)
        if kind_of(hook) not in _kinds_in(module):
            raise LookupError(f"it has no function {hook} marked with kind_hook")
    return module
