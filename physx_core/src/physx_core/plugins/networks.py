"""Resolves networks by reference, including plain classes of a deep-learning library.

A plugin named after its library (`torch`) may have a network ``module`` that adapts a class of that
library. A reference to such a class resolves to this network, with the class as its argument
``module``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from physx_core.components.network import Network
from physx_core.errors import ConfigError
from physx_core.plugins.entries import official_package
from physx_core.plugins.hookspecs import ADAPTER
from physx_core.plugins.references import check_component, find, resolve
from physx_core.plugins.registry import available, load


def resolve_network(reference: Any, arguments: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Return the class or factory of a network and the keyword arguments to call it with.

    Args:
        reference: As in `resolve`, or a class derived from a class of a plugin's library.
        arguments: The user's keyword arguments.
    """
    found = find("network", reference)
    library = _library_of(found)
    if library is None:
        check_component("network", reference, found)
        return found, dict(arguments)
    if ADAPTER in arguments:
        raise ConfigError(
            f"{found.__name__} is itself the module, so network_kwargs cannot contain "
            f'"{ADAPTER}". If it takes an argument of that name, put all its arguments into '
            'network_kwargs={"module_kwargs": {...}}.'
        )
    named = reference if isinstance(reference, str) else found
    return resolve("network", f"{library}/{ADAPTER}"), {ADAPTER: named, **arguments}


def _library_of(found: Any) -> str | None:
    """Return the plugin that adapts a plain class of its library, or None."""
    if not isinstance(found, type) or issubclass(found, Network):
        return None
    packages = dict.fromkeys(base.__module__.partition(".")[0] for base in found.__mro__)
    known = available()
    for package in packages:
        if package not in known and official_package(package) is None:
            continue
        if ADAPTER in load(package).components.get("network", {}):
            return package
    return None
