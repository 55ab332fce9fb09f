"""Creates a Gymnasium environment by name."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import gymnasium

from physx_core.errors import ComponentNotFoundError, ConfigError, PhysxError, nearest
from physx_core.plugins import import_component, import_module

_PREFIX = "gym/"
"""What ids begin with where components of all plugins are named."""


def make_env(env: str, options: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """Return a new environment.

    Args:
        env: Its id, for example ``"CartPole-v1"`` or, with a module or script that registers it,
            ``"physx_gym:physx/Ant-v0"`` and ``"script.py:Mine-v0"``; or where its class, or a
            function that returns it, is: ``"package.module:Class"``, ``"script.py:function"``.
            Each may follow ``"gym/"``.
        options: Its keyword arguments.

    Raises:
        ComponentNotFoundError: If there is no such module, script, or class in it.
        ConfigError: If it is not registered, does not accept the options, or is no environment.
    """
    env = env.removeprefix(_PREFIX)
    place, colon, name = env.rpartition(":")
    if not colon:
        return _make_registered(env, env, options)
    module = import_module("environment", place)
    first = name.partition(".")[0]
    if not first.isidentifier() or (name in gymnasium.registry and not hasattr(module, first)):
        return _make_registered(env, name, options)
    if not hasattr(module, first):
        raise ComponentNotFoundError("environment", name, place, _environments(module))
    make = import_component("environment", env)
    if isinstance(make, type) and not _is_environment(make):
        raise ConfigError(f"{env} is a class that is not derived from gymnasium.Env.")
    if not callable(make):
        raise ConfigError(f"{env} is {make!r:.80}, neither a class nor a function.")
    try:
        made = make(**options)
    except TypeError as error:
        _check_options(env, error)
        raise
    if not isinstance(made, gymnasium.Env):
        raise ConfigError(f"{env} returned a {type(made).__name__}, not a gymnasium.Env.")
    return made


def _environments(module: ModuleType) -> list[str]:
    """Return the names of a module's environments, and of functions that may return one."""
    return [
        name
        for name, value in vars(module).items()
        if getattr(value, "__module__", None) == module.__name__
        and (inspect.isfunction(value) or _is_environment(value))
    ]


def _is_environment(value: Any) -> bool:
    return isinstance(value, type) and issubclass(value, gymnasium.Env)


def _make_registered(env: str, id: str, options: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """Return a new environment that is registered with Gymnasium.

    Args:
        env: What the user calls it.
        id: Its id, whose module has been imported.
        options: Its keyword arguments.
    """
    try:
        return gymnasium.make(id, **options)
    except gymnasium.error.UnregisteredEnv as error:
        known = sorted(gymnasium.registry)
        raise ConfigError(
            f'"{env}" is not registered with Gymnasium.{nearest(id, known)} '
            f"gymnasium.pprint_registry() lists the {len(known)} that are. {error}"
        ) from error
    except (gymnasium.error.Error, ImportError) as error:  # deprecated, or a library is missing
        raise ConfigError(f"Gymnasium cannot create {env}: {error}") from error
    except TypeError as error:
        _check_options(env, error.__cause__ or error)
        raise


def _check_options(env: str, error: BaseException) -> None:
    """Raise an error that says so if a call failed because of its arguments, not within the code.

    Args:
        env: What the user calls the environment.
        error: What the call raised.
    """
    trace = error.__traceback__
    if not isinstance(error, PhysxError) and (trace is None or trace.tb_next is None):
        raise ConfigError(f"{env} does not take these arguments: {error}.") from error
