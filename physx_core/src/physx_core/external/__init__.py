"""The plugin ``external``: environments whose samples come from programs in other languages."""

from __future__ import annotations

from pathlib import Path

from physx_core.plugins.hookspecs import Components, hookimpl

INCLUDE = Path(__file__).parent / "include"
"""Folder with what such programs need: ``physx.h``, ``physx.f90`` and ``physx.py``."""


@hookimpl
def physx_environments() -> Components:
    """Return the environment that runs a program."""
    return {"program": "physx_core.external.environment:ExternalProgram"}
