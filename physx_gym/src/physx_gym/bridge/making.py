"""Making a Gymnasium environment from its name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium

from physx_core.errors import ConfigError, nearest
from physx_core.plugins import resolve


def make_env(env: str, options: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """Return a new environment.

    Args:
        env: Its id, for example ``"CartPole-v1"`` or ``"physx/Ant-v0"``; or where its class is,
            ``"package.module:Class"`` or ``"script.py:Class"``.
        options: Its keyword arguments.

    Raises:
        ConfigError: There is none of that name, or what is there is no environment.
    """
    if ":" in env:
        made = resolve("environment", env)(**options)
        if not isinstance(made, gymnasium.Env):
            raise ConfigError(f"{env} made {type(made).__name__}, which is no gymnasium.Env.")
        return made
    try:
        return gymnasium.make(env, **options)
    except gymnasium.error.UnregisteredEnv as error:
        known = sorted(gymnasium.registry)
        raise ConfigError(
            f'Gymnasium knows no environment "{env}".{nearest(env, known)} '
            f"{len(known)} are registered; gymnasium.pprint_registry() lists them. {error}"
        ) from error
