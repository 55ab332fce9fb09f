"""Entry point `dart`: what the plugin brings; nothing of it is imported yet."""

from __future__ import annotations

from physx_core.plugins import hookimpl


@hookimpl
def physx_backends() -> dict[str, str]:
    """Return the engine DART."""
    return {"dart": "physx_dart.dart.simulation:DartBackend"}


@hookimpl
def physx_environments() -> dict[str, str]:
    """Return the environments that DART simulates."""
    return {
        "arm": "physx_dart.environments.arm:DartArm",
        "double-pendulum": "physx_dart.environments.double_pendulum:DartDoublePendulum",
    }
