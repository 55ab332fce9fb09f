"""Entry point `pinocchio`: references to the plugin's components, imported when used."""

from __future__ import annotations

from physx_core.plugins import hookimpl


@hookimpl
def physx_backends() -> dict[str, str]:
    """Return the Pinocchio backend."""
    return {"pinocchio": "physx_dart.pinocchio.simulation:PinocchioBackend"}


@hookimpl
def physx_environments() -> dict[str, str]:
    """Return the environments simulated with Pinocchio."""
    return {
        "arm": "physx_dart.environments.arm:PinocchioArm",
        "double-pendulum": "physx_dart.environments.double_pendulum:PinocchioDoublePendulum",
    }
