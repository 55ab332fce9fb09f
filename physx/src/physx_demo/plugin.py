"""The plugin ``demo``: the arm of ``physx demo``, and the network that learns its dynamics."""

from __future__ import annotations

from physx_core.plugins import Components, hookimpl


@hookimpl
def physx_environments() -> Components:
    """Return the arm in random motions, and arms that follow one."""
    return {"arm": "physx_demo.arm:Arm", "tracking": "physx_demo.arm:Tracking"}


@hookimpl
def physx_networks() -> Components:
    """Return the network."""
    return {"features": "physx_demo.arm:Features"}
