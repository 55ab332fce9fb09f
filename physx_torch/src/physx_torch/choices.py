"""Looks up classes by name, and creates objects with the user's arguments."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

import torch

from physx_core.errors import ComponentNotFoundError, ConfigError, listed, nearest
from physx_core.plugins import import_component


def find_classes(module: ModuleType, base: type[Any]) -> dict[str, type[Any]]:
    """Return the public subclasses of `base` defined in a module or its submodules, by name."""
    return {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, type)
        and issubclass(value, base)
        and value is not base
        and not name.startswith("_")
        and value.__module__.startswith(module.__name__)
    }


def choose(what: str, given: Any, known: Mapping[str, Any]) -> Any:
    """Return the object with a name; anything but a string is returned unchanged.

    Args:
        what: Kind of the object, for error messages, for example ``"loss"``.
        given: A known name, ``"package.module:Name"``, or the object itself.
        known: Objects by name.
    """
    if not isinstance(given, str):
        return given
    if given in known:
        return known[given]
    if ":" in given:
        try:
            return import_component(what, given)
        except ComponentNotFoundError as error:
            raise ConfigError(
                f'There is no {what} "{given}".{nearest(error.name, error.known)}'
            ) from error
    raise ConfigError(
        f'torch has no {what} "{given}".{nearest(given, known)} It has: {listed(known)}. '
        'Specify your own as "package.module:Name".'
    )


def make(
    what: str, base: type[Any], factory: Callable[..., Any], /, *args: Any, **kwargs: Any
) -> Any:
    """Return ``factory(*args, **kwargs)``, unless the factory is a class not derived from `base`.

    Args:
        what: Kind of the object, for error messages, for example ``"loss"``.
        base: Class that the object's class must be derived from.
        factory: A class, or a function that returns an object.
        args: Positional arguments.
        kwargs: Keyword arguments.
    """
    if isinstance(factory, type) and not issubclass(factory, base):
        wanted = ".".join([*base.__module__.split(".")[:2], base.__name__])
        raise ConfigError(f"The {what} {factory.__name__} is a class, but not a {wanted}.")
    try:
        return factory(*args, **kwargs)
    except (TypeError, ValueError) as error:
        name = getattr(factory, "__name__", repr(factory))
        raise ConfigError(
            f"The {what} {name} rejects its arguments: {error}. "
            f"It takes: {', '.join(parameters_of(factory)) or 'see its documentation'}."
        ) from error


def make_activation(option: str, given: Any, channels: int) -> torch.nn.Module:
    """Return an activation.

    Args:
        option: Name of the option, for error messages, for example ``"FC.activation"``.
        given: Name of a class in `torch.nn` such as ``"SiLU"``, ``"package.module:Class"``, or a
            class.
        channels: Number of channels: `torch.nn.PReLU` learns a slope for each.
    """
    known = find_classes(torch.nn.modules.activation, torch.nn.Module)
    chosen = choose("activation", given, {**known, "Identity": torch.nn.Identity})
    slopes = {"num_parameters": channels} if chosen is torch.nn.PReLU else {}
    made = make("activation", torch.nn.Module, chosen, **slopes)
    if not isinstance(made, torch.nn.Module):
        raise ConfigError(f"{option} is {given!r} but must be a torch.nn.Module class.")
    return made


def parameters_of(factory: Callable[..., Any]) -> list[str]:
    """Return the names of a callable's parameters; empty if they are unknown."""
    try:
        return list(inspect.signature(factory).parameters)
    except (TypeError, ValueError):  # some callables written in C have no signature
        return []
