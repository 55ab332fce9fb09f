"""The plugin ``external``: environments whose samples come from programs in C, C++, or Fortran."""

from __future__ import annotations

from pathlib import Path

from physx_core.plugins.hookspecs import Components, hookimpl

INCLUDE = Path(__file__).parent / "include"
"""Include folder for compiling such programs: ``physx.h`` and ``physx.f90``."""


@hookimpl
def physx_environments() -> Components:
    """Return the environment that runs a program."""
    return {"program": "physx_core.external.environment:ExternalProgram"}
