"""The plugin ``remote``: physx's own protocols, imported when they are used."""

from __future__ import annotations

from physx_core.plugins import Components, hookimpl


@hookimpl
def physx_protocols() -> Components:
    """Return the protocols by name."""
    return {
        "physx": "physx_remote.physx.protocol:Physx",
        "godot-gym": "physx_remote.godot_gym.protocol:GodotGym",
        "godot-rl": "physx_remote.godot_rl.protocol:GodotRL",
    }
