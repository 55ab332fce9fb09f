"""Creates components with the user's options, whose errors name the component and the option."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from physx_core.components.environment import options_of
from physx_core.components.network import Network
from physx_core.config import NetworkConfig
from physx_core.errors import ConfigError, PhysxError, UnknownOptionError, listed
from physx_core.plugins.methods import name_of
from physx_core.plugins.networks import resolve_network
from physx_core.plugins.references import base_of, resolve

_OPTIONS = {
    "network": "network.network_kwargs",
    "optimization": "network.optimization_kwargs",
    "transformation": "network.transformation_kwargs",
    "launcher": "environment.launcher_kwargs",
    "sampler": "environment.sampler_kwargs",
    "visualizer": "environment.visualizer_kwargs",
    "buffer": "online_kwargs",
}
"""Kind of component to the option of a pipeline that holds its arguments."""


def create(kind: str, reference: Any, arguments: Mapping[str, Any]) -> Any:
    """Return a new component.

    Args:
        kind: See `resolve`.
        reference: See `resolve`.
        arguments: Keyword arguments of its constructor.

    Raises:
        PluginNotFoundError: As for `resolve`.
        PluginError: As for `resolve`.
        ComponentNotFoundError: As for `resolve`.
        ReferenceFormError: As for `resolve`.
        UnknownOptionError: If its class does not have one of the options.
        ConfigError: If its class is incomplete, or does not accept the arguments.
    """
    return _make(kind, reference, resolve(kind, reference), arguments)


def create_network(config: NetworkConfig) -> Network:
    """Return the network of a configuration.

    Raises:
        UnknownOptionError: If its class does not have one of the options.
        ConfigError: If its class is incomplete, or does not accept its arguments.
    """
    make, arguments = resolve_network(config.network, config.network_kwargs)
    network: Network = _make("network", config.network, make, arguments)
    for option in ("net_fields", "opt_fields", "pred_fields"):
        names = getattr(network, option)
        if isinstance(names, str) or not all(isinstance(name, str) for name in names):
            raise ConfigError(
                f"{type(network).__name__}.{option} is {names!r} but must be a list of names."
            )
    return network


def _make(kind: str, reference: Any, make: Callable[..., Any], arguments: Mapping[str, Any]) -> Any:
    name = name_of(kind, reference, make)
    try:
        component = make(**arguments)
    except PhysxError:
        raise
    except Exception as error:
        known = options_of(make) if isinstance(make, type) else list(arguments)
        unknown = arguments.keys() - set(known)
        if isinstance(error, TypeError) and unknown:
            raise UnknownOptionError(name, unknown, known) from error
        if isinstance(error, TypeError) and (missing := _missing(make, arguments)):
            place = _OPTIONS.get(kind, f"{kind}_kwargs")
            raise ConfigError(
                f"{name} needs {listed(missing)}: give it in {place.rpartition('.')[2]} "
                f"(--{place.replace('_', '-')} {missing[0]}=...)."
            ) from error
        text = f"rejects its arguments: {error}"
        if not isinstance(error, TypeError):
            text = f"raised in __init__(): {type(error).__name__}: {error}"
        raise ConfigError(f"{name} {text}.") from error
    if not isinstance(component, base_of(kind)):
        hint = (
            " Use a function that returns a component of another library through its plugin, for "
            'example network="torch/module", network_kwargs={"module": "package.module:function"}.'
        )
        raise ConfigError(
            f"{reference!r} returned a {type(component).__name__}, which is not a physx {kind}."
            + (hint if kind == "network" else "")
        )
    return component


def _missing(make: Callable[..., Any], arguments: Mapping[str, Any]) -> list[str]:
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
