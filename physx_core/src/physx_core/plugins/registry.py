"""Lists plugins without importing them, and loads one by its name."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pluggy

from physx_core.errors import PluginError, PluginNotFoundError
from physx_core.plugins import hookspecs
from physx_core.plugins.entries import (
    OFFICIAL,
    PLUGINS,
    describe_conflict,
    find_entries,
    owner_of,
)
from physx_core.plugins.hookspecs import KINDS, Components

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@dataclass(frozen=True)
class PluginInfo:
    """A plugin's metadata, read without importing it.

    Attributes:
        name: Entry-point name, by which it is selected.
        distributions: Names and versions of the packages that claim the name: normally one.
        module: Module that the entry point names.
    """

    name: str
    distributions: tuple[str, ...]
    module: str


@dataclass(frozen=True)
class Plugin:
    """A loaded plugin.

    Attributes:
        info: Its metadata.
        components: Kind of component to name to component: a class, a factory or a reference.
    """

    info: PluginInfo
    components: dict[str, Components] = field(default_factory=dict)


def available() -> dict[str, PluginInfo]:
    """Return the installed plugins by name, from metadata alone."""
    return {
        name: PluginInfo(name, tuple(map(owner_of, found)), found[0].value)
        for name, found in find_entries(PLUGINS).items()
    }


def load(name: str) -> Plugin:
    """Import a plugin and check its hooks.

    Args:
        name: Entry-point name.

    Raises:
        PluginNotFoundError: If no installed package has a plugin of that name.
        PluginError: If the plugin fails to import, misspells a hook, or is claimed by two packages.
    """
    found = find_entries(PLUGINS)
    if name not in found:
        package = OFFICIAL.get((PLUGINS, name), f"<the package that contains {name}>")
        raise PluginNotFoundError(name, list(found), f"pip install {package}")
    if len(found[name]) > 1:
        raise PluginError(name, describe_conflict("plugin", found[name]))
    return _load(found[name][0])


@functools.cache
def _load(entry: EntryPoint) -> Plugin:
    info = PluginInfo(entry.name, (owner_of(entry),), entry.value)

    def plugin_error(what: str, error: BaseException) -> PluginError:
        text = f'Plugin "{entry.name}" ({info.distributions[0]}) {what}: {error}'
        return PluginError(entry.name, text)

    try:
        module = entry.load()
    except Exception as error:  # whatever a plugin raises on import breaks that plugin only
        raise plugin_error(f"fails to import {entry.value}", error) from error
    manager = pluggy.PluginManager(PLUGINS)
    manager.add_hookspecs(hookspecs)
    try:
        manager.register(module, entry.name)
        manager.check_pending()
    except pluggy.PluginValidationError as error:
        known = ", ".join(KINDS.values())
        raise plugin_error(f"has an unknown hook (known: {known})", error) from error
    try:
        components = {kind: _call(manager, hook) for kind, hook in KINDS.items()}
    except Exception as error:  # likewise for its hooks
        raise plugin_error("fails in a hook", error) from error
    return Plugin(info, {kind: given for kind, given in components.items() if given})


def _call(manager: pluggy.PluginManager, hook: str) -> Components:
    merged: Components = {}
    for given in getattr(manager.hook, hook)():
        if not isinstance(given, dict):
            raise TypeError(f"{hook}() returned {type(given).__name__}, not a dictionary")
        merged.update(given)
    return merged
