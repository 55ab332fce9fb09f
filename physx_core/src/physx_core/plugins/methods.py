"""Checks that physx can call the methods of a component's class."""

from __future__ import annotations

import functools
import inspect
from typing import Any

from physx_core.errors import ConfigError

_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
_ANY = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def name_of(kind: str, reference: Any, found: Any) -> str:
    """Return what messages call a component, such as ``The network 'mine/wide'``."""
    return (
        f"The {kind} {reference!r}" if isinstance(reference, str) else f"The {kind} {_named(found)}"
    )


def _named(found: Any) -> str:
    return getattr(found, "__name__", repr(found))


def check_methods(kind: str, reference: Any, found: Any, base: type[Any]) -> None:
    """Check that a class has all methods of its base, which take what physx calls them with.

    Args:
        kind: Kind of the component, for messages.
        reference: The component's reference, for messages.
        found: The component; only classes are checked.
        base: Base class of its kind.

    Raises:
        ConfigError: If a method is missing, or takes other arguments.
    """
    if not isinstance(found, type):
        return
    problem = _problem_of((found, base))
    if problem:
        raise ConfigError(f"{name_of(kind, reference, found)} {problem}; see {base.__name__}.")


@functools.lru_cache(maxsize=256)
def _problem_of(classes: tuple[type[Any], type[Any]]) -> str:
    """Return what is wrong with the methods of a class; cached, as references are many."""
    cls, base = classes
    if missing := sorted(getattr(cls, "__abstractmethods__", ())):
        return f"is not complete. It lacks: {', '.join(f'{name}()' for name in missing)}"
    wrong = []
    for name in dir(base):
        own, given = inspect.getattr_static(cls, name), inspect.getattr_static(base, name)
        if name.startswith("_") or own is given:
            continue
        has, called = _signature_of(cls, name), _signature_of(base, name)
        if has is not None and called is not None and not _accepts(has, called):
            wrong.append(f"{name}{_text(has)} where physx calls {name}{_text(called)}")
    return f"has {', and '.join(wrong)}" if wrong else ""


def _signature_of(cls: type[Any], name: str) -> inspect.Signature | None:
    """Return the signature of a method as it is called; None if it is none, or unknown."""
    found = inspect.getattr_static(cls, name)
    is_plain = inspect.isfunction(found)
    if not is_plain and not isinstance(found, (staticmethod, classmethod)):
        return None
    try:
        signature = inspect.signature(getattr(cls, name))
    except (TypeError, ValueError):  # unknown, for example for a function in C
        return None
    parameters = list(signature.parameters.values())
    if is_plain and parameters and parameters[0].kind in _POSITIONAL:
        parameters = parameters[1:]  # self
    return signature.replace(parameters=parameters)


def _accepts(has: inspect.Signature, called: inspect.Signature) -> bool:
    """Return whether a method takes what its base takes, with and without the optional arguments.

    What the base takes as ``*arguments`` or ``**options``, the method may name.
    """
    parameters = called.parameters.values()
    is_open = any(each.kind in _ANY for each in parameters)
    bind = has.bind_partial if is_open else has.bind
    for optional in (True, False):
        used = [each for each in parameters if optional or each.default is each.empty]
        positional = [each.name for each in used if each.kind in _POSITIONAL]
        keywords = {each.name: None for each in used if each.kind is each.KEYWORD_ONLY}
        try:
            bind(*positional, **keywords)
        except TypeError:
            return False
    return True


def _text(signature: inspect.Signature) -> str:
    """Return the names of a signature's parameters: ``(data, *inputs)``."""
    plain = [
        each.replace(annotation=each.empty, default=each.empty)
        for each in signature.parameters.values()
    ]
    return str(inspect.Signature(plain))
