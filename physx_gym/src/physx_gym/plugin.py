"""The plugin ``gym``: every environment registered with Gymnasium, and the user's own."""

from __future__ import annotations

import functools
from typing import Any

import gymnasium

from physx_core.plugins import Components, hookimpl, is_component_name
from physx_gym.bridge.gym_environment import GymEnvironment


@hookimpl
def physx_environments() -> Components:
    """Return all environments registered with Gymnasium, and what adapts others.

    Those are named by where they are: ``"gym/module:id"``, ``"gym/script.py:function"``. The
    environment ``"gym/log"`` is that of a log, and repeats its episode.
    """
    registered = {
        id: functools.partial(GymEnvironment, id=id)
        for id in gymnasium.registry
        if is_component_name(id)
    }
    return {**registered, "module": _named, "log": _logged}


@hookimpl
def physx_evaluations() -> Components:
    """Return how policies are evaluated."""
    return {"policy": "physx_gym.cli.evaluate:EVALUATION"}


def _named(*, module: str, **kwargs: Any) -> GymEnvironment:
    return GymEnvironment(id=module, **kwargs)


def _logged(*, path: str, **kwargs: Any) -> GymEnvironment:
    from physx_gym.telemetry.logged_actions import logged_environment

    return GymEnvironment(**{**logged_environment(path), "policy": path, **kwargs})
