"""Parts of pipelines from tables: ``{"cls": <class or function>, "kwargs": <its options>}``."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import gymnasium

from physx_core.errors import ComponentNotFoundError, ConfigError, UnknownOptionError
from physx_core.plugins import import_component

_MODULES = {
    "environment": ("physx_gym",),
    "block": ("physx_gym.blocks",),
    "wrapper": ("physx_gym",),
    "component": (
        "physx_gym.tasks.rewards",
        "physx_gym.tasks.terminations",
        "physx_gym.tasks.randomizations",
        "physx_gym.tasks.quantities",
        "physx_gym",
        "physx_core",
    ),
}
"""Where each kind of part is looked up if only its name is given."""


def find(kind: str, reference: Any) -> Callable[..., Any]:
    """Return the class or function that creates a part of a pipeline.

    Args:
        kind: ``environment``, ``block``, ``wrapper``, or ``component`` for everything else.
        reference: A class or function, ``"package.module:Class"``, ``"script.py:Class"``, or the
            name of one that physx provides.
    """
    if not isinstance(reference, str):
        found = reference
    elif ":" in reference:
        found = import_component(kind, reference)
    else:
        found = _find_by_name(kind, reference)
    if not callable(found):
        raise ConfigError(
            f"{reference!r} is not a valid {kind}: give a class, its name, or its location, as in "
            '"package.module:Class".'
        )
    maker: Callable[..., Any] = found
    return maker


def _find_by_name(kind: str, name: str) -> Any:
    known: list[str] = []
    for place in _MODULES[kind]:
        module = importlib.import_module(place)
        names = list(getattr(module, "__all__", ()))
        if name in names:
            return getattr(module, name)
        known += names
    if kind == "environment":
        known += [each for each in gymnasium.registry if each.startswith("physx/")]
    raise ComponentNotFoundError(kind, name, "physx_gym", known)


def find_environment(reference: Any) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Return what creates an environment, and the options that it is registered with.

    Args:
        reference: As in `find`, or an id registered with Gymnasium.
    """
    if not isinstance(reference, str) or reference not in gymnasium.registry:
        return find("environment", reference), {}
    spec = gymnasium.registry[reference]
    if spec.entry_point is None:
        raise ConfigError(f'The environment "{reference}" is registered without an entry point.')
    return find("environment", spec.entry_point), dict(spec.kwargs)


def build(where: str, kind: str, table: Mapping[str, Any], *args: Any, **given: Any) -> Any:
    """Return the part that a table describes.

    Args:
        where: Name of the table in error messages.
        kind: See `find`.
        table: The table.
        args: First arguments of the part.
        given: Options that replace those in the table.
    """
    check_table(where, table, ("cls", "kwargs"))
    maker = find(kind, table["cls"])
    options = {**build_nested(f"{where}.kwargs", table.get("kwargs", {})), **given}
    check_call(where, maker, args, options)
    return maker(*args, **options)


def build_nested(where: str, value: Any) -> Any:
    """Return nested data in which each table with a ``cls`` is replaced by its part."""
    if isinstance(value, Mapping):
        if "cls" in value:
            return build(where, "component", value)
        return {key: build_nested(f"{where}.{key}", each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(build_nested(f"{where}[{i}]", each) for i, each in enumerate(value))
    return value


def check_table(where: str, table: Any, known: Iterable[str], required: str = "cls") -> None:
    """Check the keys of a table."""
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} is {table!r} but must be a table.")
    unknown = [str(key) for key in table if key not in known]
    if unknown:
        raise UnknownOptionError(where, unknown, known)
    if required and required not in table:
        raise ConfigError(f'{where} has no "{required}".')
    if not isinstance(table.get("kwargs", {}), Mapping):
        raise ConfigError(f"{where}.kwargs is {table['kwargs']!r} but must be a table.")


def check_call(
    where: str, maker: Callable[..., Any], args: tuple[Any, ...], options: Mapping[str, Any]
) -> None:
    """Check that a class or function accepts some arguments."""
    try:
        signature = inspect.signature(maker)
    except (TypeError, ValueError):  # implemented in C: it reports its own errors
        return
    name = getattr(maker, "__name__", repr(maker))
    parameters = signature.parameters.values()
    if not any(each.kind is each.VAR_KEYWORD for each in parameters):
        known = [
            each.name
            for each in list(parameters)[len(args) :]
            if each.kind in (each.KEYWORD_ONLY, each.POSITIONAL_OR_KEYWORD)
        ]
        unknown = set(options) - set(known)
        if unknown:
            raise UnknownOptionError(f"{where}: {name}", unknown, known)
    try:
        signature.bind(*args, **options)
    except TypeError as error:
        raise ConfigError(f"{where}: {name}: {error}.") from error
