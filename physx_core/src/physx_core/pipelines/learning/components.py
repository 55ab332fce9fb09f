"""Creates networks, optimizations and transformations, and checks that they are complete."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from physx_core.components.environment import options_of
from physx_core.components.network import Network
from physx_core.config import NetworkConfig
from physx_core.errors import ConfigError, PhysxError, UnknownOptionError, listed
from physx_core.plugins import resolve
from physx_core.plugins.networks import resolve_network


def create_network(config: NetworkConfig) -> Network:
    """Return the network of a configuration.

    Raises:
        ConfigError: If its class is incomplete, or rejects its arguments.
    """
    reference = config.network
    make, arguments = resolve_network(reference, config.network_kwargs)
    network: Network = _make("network", reference, make, arguments, Network)
    _check_fields(network)
    return network


def create(kind: str, reference: Any, arguments: Mapping[str, Any], base: type[Any]) -> Any:
    """Return the component that a reference names.

    Args:
        kind: Kind of the component.
        reference: The component's reference.
        arguments: Keyword arguments of its constructor.
        base: Class that it must derive from.

    Raises:
        ConfigError: If its class is incomplete, or rejects its arguments.
    """
    return _make(kind, reference, resolve(kind, reference), arguments, base)


def _make(
    kind: str, reference: Any, make: Any, arguments: Mapping[str, Any], base: type[Any]
) -> Any:
    name = (
        f"The {kind} {reference!r}" if isinstance(reference, str) else f"The {kind} {make.__name__}"
    )
    if inspect.isabstract(make):
        methods = ", ".join(f"{method}()" for method in sorted(make.__abstractmethods__))
        raise ConfigError(f"{name} is not complete. It lacks: {methods}; see {base.__name__}.")
    try:
        component = make(**arguments)
    except PhysxError:
        raise
    except Exception as error:
        unknown = arguments.keys() - set(options_of(make)) if isinstance(make, type) else set()
        if isinstance(error, TypeError) and unknown:
            raise UnknownOptionError(name, unknown, options_of(make)) from error
        if isinstance(error, TypeError) and (missing := _missing(make, arguments)):
            option = f"{kind}_kwargs"
            raise ConfigError(
                f"{name} needs {listed(missing)}: give it in {option} "
                f"(--network.{option.replace('_', '-')} {missing[0]}=...)."
            ) from error
        text = f"rejects its arguments: {error}"
        if not isinstance(error, TypeError):
            text = f"raised in __init__(): {type(error).__name__}: {error}"
        raise ConfigError(f"{name} {text}.") from error
    if not isinstance(component, base):
        raise ConfigError(
            f"{reference!r} returned a {type(component).__name__}, which is not a physx {kind}. "
            "Use a function that returns a component of another library through its plugin, for "
            'example network="torch/module", network_kwargs={"module": "package.module:function"}.'
        )
    return component


def _missing(make: Any, arguments: Mapping[str, Any]) -> list[str]:
    """Return the required arguments that a component is not given."""
    try:
        parameters = inspect.signature(make).parameters.values()
    except (TypeError, ValueError):  # unknown, for example for a class in C
        return []
    named = (inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return [
        each.name
        for each in parameters
        if each.kind in named and each.default is each.empty and each.name not in arguments
    ]


def _check_fields(network: Network) -> None:
    """Check the names of a network's input, predicted, and target fields."""
    for option in ("net_fields", "opt_fields", "pred_fields"):
        names = getattr(network, option)
        if isinstance(names, str) or not all(isinstance(name, str) for name in names):
            raise ConfigError(
                f"{type(network).__name__}.{option} is {names!r} but must be a list of names."
            )
