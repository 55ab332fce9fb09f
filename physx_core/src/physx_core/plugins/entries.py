"""Entry points of the installed packages, read from their metadata without importing them."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physx_core.errors import listed

if TYPE_CHECKING:  # importing it takes a third of a client's start, and few clients need it
    from importlib.metadata import Distribution, EntryPoint

PLUGINS = "physx"
"""Entry-point group of the plugins."""
COMMANDS = "physx.commands"
"""Entry-point group of the commands: command name to a module with ``run(words)``."""
HOOKSPECS = "physx.hookspecs"
"""Entry-point group of further kinds of components: hook name to a module with the hookspec."""
CHECKS = "physx.checks"
"""Entry-point group of conformance checks: kind of component to a module with ``CHECKS``."""

_GROUPS = {PLUGINS: "plugins", COMMANDS: "commands", HOOKSPECS: "hooks"}


def official_package(name: str, group: str = PLUGINS) -> str | None:
    """Return the package of the physx project that has an entry point, installed or not."""
    return _official().get((group, name))


def official_modules() -> list[str]:
    """Return the names of the physx project's other packages, as they are imported."""
    return [package.replace("-", "_") for package in _packages()]


@functools.cache
def _packages() -> dict[str, Any]:
    return tomllib.loads(Path(__file__).with_name("packages.toml").read_text())


@functools.cache
def _official() -> dict[tuple[str, str], str]:
    return {
        (group, name): package
        for package, entries in _packages().items()
        for group, key in _GROUPS.items()
        for name in entries.get(key, ())
    }


def find_entries(group: str) -> dict[str, list[EntryPoint]]:
    """Return a group's entry points by name; several if several packages claim the name."""
    return _read_entries(_installed())[0][group]


def find_owners(group: str) -> dict[str, tuple[str, ...]]:
    """Return the names and versions of the packages that have a group's entry points, by name."""
    return _owners(group, _installed())


@functools.lru_cache(maxsize=4)
def _owners(group: str, installed: tuple[tuple[str, int], ...]) -> dict[str, tuple[str, ...]]:
    # Cached: references are resolved often, and this parses each package's whole METADATA.
    entries = _read_entries(installed)[0][group]
    return {name: tuple(map(owner_of, found)) for name, found in entries.items()}


def find_unreadable() -> dict[str, str]:
    """Return the packages whose entry points cannot be read, with the reason."""
    return _read_entries(_installed())[1]


def unreadable_hint() -> str:
    """Return a sentence on packages whose entry points cannot be read; empty if there are none."""
    found = find_unreadable()
    if not found:
        return ""
    return f"The entry points of {listed(found)} cannot be read: reinstall or remove it."


def _installed() -> tuple[tuple[str, int], ...]:
    return tuple((entry, _last_change(entry)) for entry in sys.path)


def _last_change(folder: str) -> int:
    """Return the time at which a folder's packages last changed; 0 if there is no such folder."""
    try:
        return os.stat(folder or ".").st_mtime_ns  # noqa: PTH116 - each resolve asks for all
    except OSError:
        return 0


@functools.lru_cache(maxsize=1)
def _read_entries(
    installed: tuple[tuple[str, int], ...],
) -> tuple[dict[str, dict[str, list[EntryPoint]]], dict[str, str]]:
    """Read the metadata of all packages, once for all groups; cached until one is installed.

    Returns:
        Group to name to entry points, and the unreadable packages with the reason.
    """
    found: list[EntryPoint] = []
    unreadable: dict[str, str] = {}
    seen: set[str] = set()
    for folder in dict.fromkeys(installed):
        for name, entries, problem in _read_folder(*folder):
            if problem:
                unreadable[name] = problem
            elif name not in seen:  # Python imports from the first folder that contains it
                found += entries
            seen.add(name)
    groups = (PLUGINS, COMMANDS, HOOKSPECS, CHECKS)
    return {
        group: _by_name(entry for entry in found if entry.group == group) for group in groups
    }, unreadable


@functools.lru_cache(maxsize=64)
def _read_folder(folder: str, last_change: int) -> list[tuple[str, list[EntryPoint], str]]:
    """Return the name, entry points, and any problem with them, of each package in a folder."""
    from importlib.metadata import distributions

    packages: list[tuple[str, list[EntryPoint], str]] = []
    for package in distributions(path=[folder]):
        try:
            # From the folder's name, like importlib.metadata; reading all metadata is slow.
            name = getattr(package, "_normalized_name", None) or _name_of(package)
            packages.append((name, list(package.entry_points), ""))
        except Exception as error:  # a foreign package's file, which may contain anything
            packages.append((_name_of(package), [], f"{type(error).__name__}: {error}"))
    return packages


def _by_name(entries: Iterable[EntryPoint]) -> dict[str, list[EntryPoint]]:
    found: dict[str, list[EntryPoint]] = {}
    for entry in sorted(entries, key=lambda entry: entry.name):
        found.setdefault(entry.name, []).append(entry)
    for name, claims in found.items():
        if len(claims) > 1:  # an editable package can be listed twice by its own metadata
            found[name] = list({owner_of(entry): entry for entry in claims}.values())
    return found


def owner_of(entry: EntryPoint) -> str:
    """Return the name and version of the distribution that contains an entry point."""
    if entry.dist is None:
        return entry.value
    version = None
    with contextlib.suppress(Exception):  # its metadata is damaged
        version = entry.dist.version
    return f"{_name_of(entry.dist)} {version or 'without a version'}"


def _name_of(package: Distribution) -> str:
    """Return a package's name, or its location if the metadata does not contain a name."""
    try:
        return str(package.metadata["Name"] or package.locate_file(""))
    except Exception:  # its metadata is damaged
        return str(package.locate_file(""))


def unmet_requirements(package: Distribution) -> list[str]:
    """Return a sentence for each package that a package requires, but finds not, or too old or new.

    Args:
        package: The package; those that only its extras require are left out.
    """
    from importlib.metadata import PackageNotFoundError, version

    try:
        from packaging.requirements import InvalidRequirement, Requirement
    except ImportError:  # a client's interpreter may lack it
        return []
    found = []
    for line in package.requires or []:
        with contextlib.suppress(InvalidRequirement):
            needed = Requirement(line)
            if needed.marker and not needed.marker.evaluate({"extra": ""}):
                continue
            text = f"{_name_of(package)} requires {needed.name}{needed.specifier}"
            try:
                present = version(needed.name)
            except PackageNotFoundError:
                found.append(f"{text}, which is not installed.")
                continue
            if not needed.specifier.contains(present, prereleases=True):
                found.append(f"{text}, but {present} is installed.")
    return found


def describe_conflict(kind: str, entries: list[EntryPoint]) -> str:
    """Return the error message for several packages that claim one name."""
    owners = " and ".join(sorted(map(owner_of, entries)))
    return f'The {kind} name "{entries[0].name}" is claimed by {owners}; uninstall or rename one.'
