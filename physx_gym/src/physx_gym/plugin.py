"""The plugin ``gym``: every environment registered with Gymnasium, by its id."""

from __future__ import annotations

import functools

import gymnasium

from physx_core.plugins import Components, hookimpl, is_component_name
from physx_gym.bridge.gym_environment import GymEnvironment


@hookimpl
def physx_environments() -> Components:
    """Return all environments registered with Gymnasium."""
    return {
        id: functools.partial(GymEnvironment, id=id)
        for id in gymnasium.registry
        if is_component_name(id)
    }
