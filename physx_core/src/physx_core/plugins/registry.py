"""Finding plugins without importing them, and loading one by its name."""

from __future__ import annotations

import functools
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pluggy

from physx_core.errors import PluginError, PluginNotFoundError
from physx_core.plugins import hookspecs
from physx_core.plugins.hookspecs import GROUP, KINDS, Components

if TYPE_CHECKING:  # it takes a third of a client's start, and few clients need it
    from importlib.metadata import EntryPoint

OFFICIAL = {
    "dart": "physx-dart",
    "pinocchio": "physx-dart",
    "torch": "physx-torch",
    "rerun": "physx-rerun",
}
"""Plugins of the physx project and the distributions that bring them."""


@dataclass(frozen=True)
class PluginInfo:
    """What the installed packages' metadata say about a plugin; nothing of it was imported.

    Attributes:
        name: Entry-point name, by which it is selected.
        distributions: Names and versions of the packages that claim the name; one, if all is well.
        module: Module that the entry point names.
    """

    name: str
    distributions: tuple[str, ...]
    module: str


@dataclass(frozen=True)
class Plugin:
    """A loaded plugin.

    Attributes:
        info: What its metadata say.
        components: Kind of component to name to component, a class, a factory or a text.
    """

    info: PluginInfo
    components: dict[str, Components] = field(default_factory=dict)


def available() -> dict[str, PluginInfo]:
    """Return the installed plugins by name, from metadata alone."""
    return {
        name: PluginInfo(name, tuple(_owner(e) for e in found), found[0].value)
        for name, found in sorted(_found().items())
    }


def load(name: str) -> Plugin:
    """Import a plugin and check its hooks.

    Args:
        name: Entry-point name.

    Raises:
        PluginNotFoundError: No package brings a plugin of that name.
        PluginError: The plugin fails to import, misspells a hook, or two packages claim its name.
    """
    found = _found()
    if name not in found:
        package = OFFICIAL.get(name, f"<the package that brings {name}>")
        raise PluginNotFoundError(name, sorted(found), f"pip install {package}")
    entries = found[name]
    if len(entries) > 1:
        owners = " and ".join(_owner(entry) for entry in entries)
        raise PluginError(name, f'The plugin name "{name}" is claimed by {owners}; uninstall one.')
    return _load(entries[0])


def _found() -> dict[str, list[EntryPoint]]:
    return _entries(tuple((entry, _changed(entry)) for entry in sys.path))


def _changed(folder: str) -> int:
    """Return when a package was last installed into a folder, or removed; 0: there is no folder."""
    try:
        return Path(folder).stat().st_mtime_ns
    except OSError:
        return 0


@functools.lru_cache(maxsize=1)
def _entries(installed: tuple[tuple[str, int], ...]) -> dict[str, list[EntryPoint]]:
    """Read the metadata of all packages, which takes some ms; once for what is installed."""
    from importlib.metadata import entry_points

    # An editable package can be listed twice by its own metadata: one owner counts once.
    found: dict[str, dict[str, EntryPoint]] = {}
    for entry in entry_points(group=GROUP):
        found.setdefault(entry.name, {}).setdefault(_owner(entry), entry)
    return {name: list(owners.values()) for name, owners in found.items()}


def _owner(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value


@functools.cache
def _load(entry: EntryPoint) -> Plugin:
    info = PluginInfo(entry.name, (_owner(entry),), entry.value)

    def failed(what: str, error: BaseException) -> PluginError:
        text = f'Plugin "{entry.name}" ({info.distributions[0]}) {what}: {error}'
        return PluginError(entry.name, text)

    try:
        module = entry.load()
    except Exception as error:  # whatever a plugin raises on import breaks that plugin only
        raise failed(f"fails to import {entry.value}", error) from error
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(hookspecs)
    try:
        manager.register(module, entry.name)
        manager.check_pending()
    except pluggy.PluginValidationError as error:
        known = ", ".join(KINDS.values())
        raise failed(f"has a hook that physx does not know (its hooks: {known})", error) from error
    try:
        components = {kind: _call(manager, hook) for kind, hook in KINDS.items()}
    except Exception as error:  # likewise for its hooks
        raise failed("fails in a hook", error) from error
    return Plugin(info, {kind: given for kind, given in components.items() if given})


def _call(manager: pluggy.PluginManager, hook: str) -> Components:
    merged: Components = {}
    for given in getattr(manager.hook, hook)():
        if not isinstance(given, dict):
            raise TypeError(f"{hook}() returned {type(given).__name__}, not a dictionary")
        merged.update(given)
    return merged


def pip_line(name: str) -> str | None:
    """Return the pip line for a plugin of the physx project, None for any other name."""
    return f"pip install {OFFICIAL[name]}" if name in OFFICIAL else None


def components_of(kind: str, plugin: Plugin) -> dict[str, Any]:
    """Return a plugin's components of one kind by name; empty if it has none."""
    return plugin.components.get(kind, {})
