"""Options of environments that inherit from several classes."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from physx_core.errors import UnknownOptionError


def construct_next(kind: type[Any], env: Any, options: Mapping[str, Any]) -> None:
    """Call the constructor of the class after another one in an environment's order of classes.

    Args:
        kind: That other one.
        env: The environment.
        options: What the constructor is given.

    Raises:
        UnknownOptionError: There are options, but no class that takes them.
    """
    order = type(env).__mro__
    after = order[order.index(kind) + 1 :]
    takes = [each for each in after if "__init__" in vars(each) and each is not object]
    if options and not takes:
        raise UnknownOptionError(type(env).__name__, options, _names(kind, type(env)))
    super(kind, env).__init__(**options)


def _names(kind: type[Any], own: type[Any]) -> list[str]:
    """Return the options of a class; of those that it hands on, the ones with a default."""
    known = inspect.signature(kind.__init__).parameters.values()
    given = inspect.signature(own.__init__).parameters.values()
    found = {each.name: each for each in [*given][1:]}
    if any(each.kind is each.VAR_KEYWORD for each in given):
        found |= {each.name: each for each in known if each.default is not each.empty}
    several = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    return [name for name, each in found.items() if each.kind not in several]
