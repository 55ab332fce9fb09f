"""Environments in other processes: serving them, and driving those that others serve.

The public names are imported when they are first used.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {
    "Communication": "communication",
    "Connection": "connections",
    "GodotGymClient": "clients.godot_gym",
    "GodotGymEnv": "clients.godot_gym",
    "GodotRLEnv": "clients.godot_rl",
    "GodotRLVectorEnv": "clients.godot_rl",
    "Messages": "messages",
    "PhysicsFramesTimer": "timer",
    "PhysxClient": "clients.physx",
    "PhysxEnv": "clients.physx",
    "PhysxObserver": "clients.physx_observer",
    "PhysxVectorEnv": "clients.physx_vector",
    "Protocol": "protocol",
    "RLAgent": "agent",
    "RLEnvWorld": "world",
    "RLEnvironment": "environment",
    "SampleEnv": "samples",
    "Service": "protocol",
    "SocketService": "serving",
    "Worlds": "worlds",
    "connect": "starting",
    "connect_vector": "starting",
    "fill": "messages",
    "open_worlds": "worlds",
    "serve": "starting",
    "write_launcher": "protocols.godot_rl_launch",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted([*globals(), *__all__])
