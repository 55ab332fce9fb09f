"""The plugin ``external``: environments whose samples come from programs in C, C++ or Fortran."""

from __future__ import annotations

from pathlib import Path

from physx_core.plugins.hookspecs import Components, hookimpl

INCLUDE = Path(__file__).parent / "include"
"""Folder of what such a program is compiled with: ``physx.h`` and ``physx.f90``."""


@hookimpl
def physx_environments() -> Components:
    """Return the environment of a program."""
    return {"program": "physx_core.external.environment:ExternalProgram"}
