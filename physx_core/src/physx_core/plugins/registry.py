"""Lists plugins without importing them, and loads a plugin by name."""

from __future__ import annotations

import functools
import inspect
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pluggy

from physx_core.errors import PluginError, PluginNotFoundError, listed, nearest
from physx_core.origin import install_hint
from physx_core.plugins import hookspecs
from physx_core.plugins.entries import (
    HOOKSPECS,
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
    with loading(entry.name, who, f"fails to import {entry.value}", entry.dist):
        module = entry.load()
    if problem := _problem_of(module, entry.value):
        raise PluginError(entry.name, f"{who} {problem}")
    manager = pluggy.PluginManager(PLUGINS)
    manager.add_hookspecs(hookspecs)
    added = [hook for hook in further_hooks() if hasattr(module, hook)]
    for hook in added:
        manager.add_hookspecs(hookspecs_of(hook))
    hooks = {kind: hook_of(kind) for kind in CORE_KINDS} | {kind_of(hook): hook for hook in added}
    manager.register(module, entry.name)
    components: dict[str, Components] = {}
    for kind, hook in hooks.items():
        with loading(entry.name, who, f"fails in {hook}()"):
            returned = getattr(manager.hook, hook)()
        for given in returned:
            if problem := _problem_of_components(given):
                raise PluginError(entry.name, f"{who}: {hook}() {problem}")
            components.setdefault(kind, {}).update(given)
    return Plugin(info, {kind: given for kind, given in components.items() if given})


def _problem_of(module: Any, place: str) -> str:
    """Return what is wrong with the hooks of a plugin's module; empty if nothing is."""
    members, known = getattr(module, "__dict__", {}), list(map(hook_of, kind_names()))
    hooks = {
        name: member
        for name, member in members.items()
        if inspect.isroutine(member) and hasattr(member, f"{PLUGINS}_impl")
    }
    if not hooks:
        unmarked = [f"{name}()" for name in known if name in members]
        what = f"{listed(unmarked)} in {place} is not" if unmarked else f"nothing in {place} is"
        return (
            f"has no hooks: {what} marked with hookimpl. A plugin is a module with functions such "
            "as physx_environments(), which return components by name."
        )
    for name, hook in hooks.items():
        if name not in known and not vars(hook)[f"{PLUGINS}_impl"]["optionalhook"]:
            package = official_package(name, HOOKSPECS)
            hint = f" It is one of {package}. {install_hint(package)}" if package else ""
            hint = hint or nearest(name, known) or f" Hooks: {', '.join(known)}."
            return f"has an unknown hook {name}.{hint}"
        if arguments := inspect.signature(hook).parameters:
            return f"has {name}({', '.join(arguments)}): hooks take no arguments."
    return ""


def _problem_of_components(given: Any) -> str:
    """Return what is wrong with what a hook returned; empty if nothing is."""
    if not isinstance(given, dict):
        return f"returned {type(given).__name__}, not a dictionary"
    wrong = [name for name in given if not is_component_name(name)]
    return f"names a component {wrong[0]!r}: {_NAMES}" if wrong else ""


def plugin_hint(name: str) -> str:
    """Return advice about a plugin that is not installed."""
    package = official_package(name)
    if package is not None:
        return install_hint(package)
    return unreadable_hint() or (
        "It is not one of physx's own: install the package that contains it. To name a class "
        'without a plugin, use "package.module:Class" or "script.py:Class".'
    )
