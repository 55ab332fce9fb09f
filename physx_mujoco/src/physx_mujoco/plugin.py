"""Entry point `mujoco`: references to the plugin's components, imported when used."""

from __future__ import annotations

from physx_core.plugins import hookimpl


@hookimpl
def physx_backends() -> dict[str, str]:
    """Return the MuJoCo backend."""
    return {"mujoco": "physx_mujoco.simulation:MujocoBackend"}
