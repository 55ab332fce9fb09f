"""Entry point `dart`: references to the plugin's components, imported when used."""

from __future__ import annotations

from physx_core.plugins import hookimpl


@hookimpl
def physx_backends() -> dict[str, str]:
    """Return the DART backend."""
    return {"dart": "physx_dart.dart.simulation:DartBackend"}


@hookimpl
def physx_environments() -> dict[str, str]:
    """Return the environments simulated with DART."""
    return {
        "arm": "physx_dart.environments.arm:DartArm",
        "double-pendulum": "physx_dart.environments.double_pendulum:DartDoublePendulum",
    }
