"""Creates a Gymnasium environment by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium

from physx_core.errors import ConfigError, nearest
from physx_core.plugins import import_component


def make_env(env: str, options: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """Return a new environment.

    Args:
        env: Its id, for example ``"CartPole-v1"`` or, with a module to import first,
            ``"physx_gym:physx/Ant-v0"``; or the location of its class, ``"package.module:Class"``
            or ``"script.py:Class"``.
        options: Its keyword arguments.
    """
    _, colon, name = env.rpartition(":")
    if colon and name.replace(".", "").isidentifier():
        make = import_component("environment", env)
        if isinstance(make, type) and not issubclass(make, gymnasium.Env):
            raise ConfigError(f"{env} is a class that is not derived from gymnasium.Env.")
        made = make(**options)
        if not isinstance(made, gymnasium.Env):
            raise ConfigError(f"{env} returned a {type(made).__name__}, not a gymnasium.Env.")
        return made
    try:
        return gymnasium.make(env, **options)
    except gymnasium.error.UnregisteredEnv as error:
        known = sorted(gymnasium.registry)
        raise ConfigError(
            f'"{env}" is not registered with Gymnasium.{nearest(env, known)} '
            f"gymnasium.pprint_registry() lists the {len(known)} that are. {error}"
        ) from error
