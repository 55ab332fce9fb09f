"""Lists plugins without importing them, and loads a plugin by name."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pluggy

from physx_core.errors import PluginError, PluginNotFoundError
from physx_core.origin import install_hint
from physx_core.plugins import hookspecs
from physx_core.plugins.entries import (
    PLUGINS,
    describe_conflict,
    find_entries,
    find_owners,
    official_package,
    owner_of,
    unreadable_hint,
)
from physx_core.plugins.hookspecs import Components, is_component_name, is_plugin_name
from physx_core.plugins.kinds import (
    CORE_KINDS,
    further_hooks,
    hook_of,
    hookspecs_of,
    kind_names,
    kind_of,
)
from physx_core.plugins.loading import loading

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_NAMES = 'names consist of letters, digits, "_", "-" and "."'


@dataclass(frozen=True)
class PluginInfo:
    """A plugin's metadata, read without importing it.

    Attributes:
        name: Entry-point name, by which users select it.
        distributions: Names and versions of the packages that claim the name, normally one.
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
        components: Kind of component to name to component: a class, a factory, or a reference.
    """

    info: PluginInfo
    components: dict[str, Components] = field(default_factory=dict)


def available() -> dict[str, PluginInfo]:
    """Return the installed plugins by name, from metadata only."""
    owners = find_owners(PLUGINS)
    return {
        name: PluginInfo(name, owners[name], found[0].value)
        for name, found in find_entries(PLUGINS).items()
    }


def load(name: str) -> Plugin:
    """Import a plugin and check its hooks.

    Args:
        name: Entry-point name.

    Raises:
        PluginNotFoundError: If no installed package has a plugin of that name.
        PluginError: If the plugin cannot be imported, misspells a hook, or is claimed by several
            packages.
    """
    found = find_entries(PLUGINS)
    if name not in found:
        raise PluginNotFoundError(name, list(found), plugin_hint(name))
    if len(found[name]) > 1:
        raise PluginError(name, describe_conflict("plugin", found[name]))
    return _load(found[name][0])


@functools.cache
def _load(entry: EntryPoint) -> Plugin:
    info = PluginInfo(entry.name, (owner_of(entry),), entry.value)
    who = f'Plugin "{entry.name}" ({info.distributions[0]})'
    if not is_plugin_name(entry.name):
        raise PluginError(entry.name, f"{who} cannot have this name: {_NAMES}.")
    with loading(entry.name, who, f"fails to import {entry.value}"):
        module = entry.load()
    manager = pluggy.PluginManager(PLUGINS)
    manager.add_hookspecs(hookspecs)
    added = [hook for hook in further_hooks() if hasattr(module, hook)]
    for hook in added:
        manager.add_hookspecs(hookspecs_of(hook))
    hooks = {kind: hook_of(kind) for kind in CORE_KINDS} | {kind_of(hook): hook for hook in added}
    try:
        manager.register(module, entry.name)
        manager.check_pending()
    except pluggy.PluginValidationError as error:
        known = ", ".join(map(hook_of, kind_names()))
        text = f"{who} has an unknown hook (known: {known}): {error}"
        raise PluginError(entry.name, text) from error
    with loading(entry.name, who, "fails in a hook"):
        components = {kind: _call(manager, hook) for kind, hook in hooks.items()}
    return Plugin(info, {kind: given for kind, given in components.items() if given})


def _call(manager: pluggy.PluginManager, hook: str) -> Components:
    merged: Components = {}
    for given in getattr(manager.hook, hook)():
        if not isinstance(given, dict):
            raise TypeError(f"{hook}() returned {type(given).__name__}, not a dictionary")
        for name in given:
            if not is_component_name(name):
                raise ValueError(f"{hook}() names a component {name!r}: {_NAMES}")
        merged.update(given)
    return merged


def plugin_hint(name: str) -> str:
    """Return advice about a plugin that is not installed."""
    package = official_package(name)
    if package is not None:
        return install_hint(package)
    return unreadable_hint() or (
        "It is not one of physx's own: install the package that contains it. To name a class "
        'without a plugin, use "package.module:Class" or "script.py:Class".'
    )
