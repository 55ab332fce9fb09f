"""Entry point `pinocchio`: what the plugin brings; nothing of it is imported yet."""

from __future__ import annotations

from physx_core.plugins import hookimpl


@hookimpl
def physx_backends() -> dict[str, str]:
    """Return the engine Pinocchio."""
    return {"pinocchio": "physx_dart.pinocchio.simulation:PinocchioBackend"}


@hookimpl
def physx_environments() -> dict[str, str]:
    """Return the environments that Pinocchio simulates."""
    return {
        "arm": "physx_dart.environments.arm:PinocchioArm",
        "double-pendulum": "physx_dart.environments.double_pendulum:PinocchioDoublePendulum",
    }
