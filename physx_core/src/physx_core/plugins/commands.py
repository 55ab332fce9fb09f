"""Commands of the installed packages, as modules."""

from __future__ import annotations

from types import ModuleType

from physx_core.errors import PluginError, UsageError, nearest
from physx_core.origin import install_hint
from physx_core.plugins.entries import (
    COMMANDS,
    describe_conflict,
    find_entries,
    official_package,
    owner_of,
)
from physx_core.plugins.loading import loading


def find_command(name: str) -> ModuleType:
    """Import the module of a command.

    Args:
        name: The word after ``physx``.

    Raises:
        UsageError: If no installed package has it.
        PluginError: If several have it, or it is broken.
    """
    commands = find_entries(COMMANDS)
    if name not in commands:
        package = official_package(name, COMMANDS)
        if package is not None:
            raise UsageError(f"physx {name} is part of {package}. {install_hint(package)}")
        guess = nearest(name, commands)
        raise UsageError(f'There is no command "{name}".{guess} See physx --help.')
    entry, *others = commands[name]
    if others:
        raise PluginError(name, describe_conflict("command", commands[name]))
    with loading(name, f"physx {name} ({owner_of(entry)})", f"fails to import {entry.value}"):
        module: ModuleType = entry.load()
        if not callable(getattr(module, "run", None)):
            raise LookupError("it has no function run")
    return module
