"""Creation of environments: their constructors must pass on what every environment gets."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from physx_core.components.environment import Environment, options_of
from physx_core.errors import PhysxError, UnknownOptionError, UsageError
from physx_core.plugins import resolve
from physx_core.plugins.references import adapters_hint


def create_environment(
    reference: str | Callable[..., Any], arguments: Mapping[str, Any], call: Callable[..., Any]
) -> Environment:
    """Create an environment, and check that its constructor has passed on its arguments.

    Args:
        reference: The reference.
        arguments: Keyword arguments, with ``instance_id``, ``instance_nb`` and ``seed``.
        call: Calls a function, given after a name for it and before its arguments, and raises its
            errors as those of the instance.
    """
    make = call("import", resolve, "environment", reference)
    name = getattr(make, "__name__", repr(make))
    try:
        _check_constructor(name, make, arguments)
        environment = call("__init__", make, **arguments)
    except PhysxError as error:
        if not isinstance(make, type) and "instance_id" in str(error):
            error.add_note(adapters_hint("environment", reference).strip())
        raise
    if not isinstance(environment, Environment):
        raise UsageError(
            f"{reference!r} returned {environment!r}, which is not an Environment."
            f"{adapters_hint('environment', reference)}"
        )
    if environment._has_seed is None:
        raise UsageError(f"{name}.__init__() must call super().__init__(**kwargs).")
    given = (environment.instance_id, environment.instance_nb, environment._has_seed)
    if given != (arguments["instance_id"], arguments["instance_nb"], True):
        raise UsageError(
            f"{name}.__init__() must pass instance_id, instance_nb and seed to "
            "super().__init__(): take **kwargs and call super().__init__(**kwargs)."
        )
    _warn_of_misspelt_methods(type(environment))
    return environment


def _warn_of_misspelt_methods(cls: type[Environment]) -> None:
    """Warn about methods that are never called but whose names resemble optional ones."""
    own = [name for name in dir(cls) if not name.startswith("_") and not hasattr(Environment, name)]
    optional = ("init_visualization", "check_sample", "apply_prediction", "reset_parameters")
    for method in optional:
        if getattr(cls, method) is getattr(Environment, method):
            import difflib

            for name in difflib.get_close_matches(method, own, n=1, cutoff=0.85):
                warnings.warn(
                    f"physx does not call {cls.__name__}.{name}(). Did you mean {method}()?",
                    stacklevel=2,
                )


def _check_constructor(name: str, make: Any, arguments: Mapping[str, Any]) -> None:
    """Check that an environment can be created with the arguments.

    Raises:
        UsageError: If it does not accept those that every environment gets.
        UnknownOptionError: If it does not accept one of the user's.
    """
    try:
        parameters = inspect.signature(make).parameters.values()
    except (TypeError, ValueError):  # unknown, for example for a class in C
        return
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    named = (inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    known = {parameter.name for parameter in parameters if parameter.kind in named}
    missing = [option for option in ("instance_id", "instance_nb", "seed") if option not in known]
    if missing:
        raise UsageError(
            f"{name}.__init__() does not take {', '.join(missing)}: it must take **kwargs and pass "
            "them to super().__init__(**kwargs)."
        )
    unknown = arguments.keys() - known
    if unknown:
        options = options_of(make) if isinstance(make, type) else known
        raise UnknownOptionError(name, unknown, options)
