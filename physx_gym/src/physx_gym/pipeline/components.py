"""Parts of pipelines as plain data: a table with the name of a class and its options."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import gymnasium

from physx_core.errors import ComponentNotFoundError, ConfigError, UnknownOptionError
from physx_core.plugins import imported

_MODULES = {
    "environment": ("physx_gym", "physx_gym.environments"),
    "block": ("physx_gym.blocks",),
    "wrapper": ("physx_gym",),
    "component": (
        "physx_gym.tasks.rewards",
        "physx_gym.tasks.terminations",
        "physx_gym.tasks.quantities",
        "physx_gym",
        "physx_core",
    ),
}
"""Where each kind of part is looked for by its name alone."""


def find(kind: str, reference: Any) -> Callable[..., Any]:
    """Return the class or function that makes a part of a pipeline.

    Args:
        kind: ``environment``, ``block``, ``wrapper``, or ``component`` for everything else.
        reference: A class or function, ``"package.module:Class"``, ``"script.py:Class"``, or the
            name of one that physx brings.

    Raises:
        ComponentNotFoundError: There is none of that name.
        ConfigError: It can be none.
    """
    if not isinstance(reference, str):
        found = reference
    elif ":" in reference:
        found = imported(kind, reference)
    else:
        found = _own(kind, reference)
    if not callable(found):
        raise ConfigError(
            f"{reference!r} makes no {kind}: give a class, its name, or where it is, as in "
            '"package.module:Class".'
        )
    made: Callable[..., Any] = found
    return made


def _own(kind: str, name: str) -> Any:
    known: list[str] = []
    for place in _MODULES[kind]:
        try:
            module = importlib.import_module(place)
        except ModuleNotFoundError as error:
            if error.name != place:
                raise
            continue
        names = list(getattr(module, "__all__", ()))
        if name in names:
            return getattr(module, name)
        known += names
    if kind == "environment":
        known += [each for each in gymnasium.registry if each.startswith("physx/")]
    raise ComponentNotFoundError(kind, name, "physx_gym", known)


def find_environment(reference: Any) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Return what makes an environment, and the options that it is registered with.

    Args:
        reference: As in `find`, or an id that Gymnasium knows.
    """
    if not isinstance(reference, str) or reference not in gymnasium.registry:
        return find("environment", reference), {}
    spec = gymnasium.registry[reference]
    entry = spec.entry_point
    if entry is None:
        raise ConfigError(f'The environment "{reference}" is registered without an entry point.')
    return find("environment", entry), dict(spec.kwargs)


def make(where: str, kind: str, table: Any, *args: Any, **extra: Any) -> Any:
    """Return the part that a table ``{"cls": ..., "kwargs": {...}}`` describes.

    Args:
        where: What to call the table in errors.
        kind: See `find`.
        table: The table.
        args: First arguments of the part.
        extra: Options in place of those in the table.
    """
    check_table(where, table, ("cls", "kwargs"))
    made = find(kind, table["cls"])
    options = {**built(f"{where}.kwargs", table.get("kwargs", {})), **extra}
    check_call(where, made, args, options)
    return made(*args, **options)


def built(where: str, value: Any) -> Any:
    """Return plain data with every table that has a ``cls`` replaced by the part it describes."""
    if isinstance(value, Mapping):
        if "cls" in value:
            return make(where, "component", value)
        return {key: built(f"{where}.{key}", each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(built(f"{where}[{i}]", each) for i, each in enumerate(value))
    return value


def check_table(where: str, table: Any, known: Iterable[str], required: str = "cls") -> None:
    """Check that a table has no other keys than known ones, and one that it must have.

    Raises:
        UnknownOptionError: It has another one.
        ConfigError: It is no table, or that one is missing.
    """
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} is {table!r} but must be a table.")
    unknown = [str(key) for key in table if key not in known]
    if unknown:
        raise UnknownOptionError(where, unknown, known)
    if required and required not in table:
        raise ConfigError(f'{where} has no "{required}".')


def check_call(
    where: str, made: Callable[..., Any], args: tuple[Any, ...], options: Mapping[str, Any]
) -> None:
    """Check that a class or function takes arguments.

    Raises:
        UnknownOptionError: It has no option of a name.
        ConfigError: One is missing.
    """
    try:
        signature = inspect.signature(made)
    except (TypeError, ValueError):  # made in C: it says itself what it does not take
        return
    name = getattr(made, "__name__", repr(made))
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
