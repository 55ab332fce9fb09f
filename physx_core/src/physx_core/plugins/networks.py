"""Networks by reference, among them classes of a deep-learning library that know nothing of physx.

A plugin that is named as its library is (`torch`) may bring a network ``module``. Whoever names a
class of that library as the network gets it through this one, with the class as ``module``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from physx_core.components.network import Network
from physx_core.errors import ConfigError
from physx_core.plugins.references import resolve
from physx_core.plugins.registry import available, components_of, load, pip_line

_ADAPTER = "module"


def resolve_network(reference: Any, arguments: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Return the class or factory of a network and the keyword arguments to call it with.

    Args:
        reference: As in `resolve`; also a class whose base belongs to the library of a plugin.
        arguments: The user's keyword arguments.

    Raises:
        ConfigError: The library's class and the plugin's network both take an argument.
        PluginNotFoundError: The library's plugin is not installed.
        PhysxError: The reference leads nowhere: see `resolve`.
    """
    found = resolve("network", reference)
    library = _library_of(found)
    if library is None:
        return found, dict(arguments)
    if _ADAPTER in arguments:
        raise ConfigError(
            f"{found.__name__} is itself the module, so network_kwargs cannot name another one "
            f'in "{_ADAPTER}". If it takes an argument of that name, put all of its own arguments '
            'into network_kwargs={"module_kwargs": {...}}.'
        )
    named = reference if isinstance(reference, str) else found
    return resolve("network", f"{library}/{_ADAPTER}"), {_ADAPTER: named, **arguments}


def _library_of(found: Any) -> str | None:
    """Return the plugin through which a class of its library becomes a network, or None."""
    if not isinstance(found, type) or issubclass(found, Network):
        return None
    packages = dict.fromkeys(base.__module__.partition(".")[0] for base in found.__mro__)
    known = available()
    for package in packages:
        if package not in known and pip_line(package) is None:
            continue
        if _ADAPTER in components_of("network", load(package)):
            return package
    return None
