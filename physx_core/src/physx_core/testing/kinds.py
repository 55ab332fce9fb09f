"""The checks of each kind of component, by name."""

from __future__ import annotations

import importlib
from collections.abc import Mapping

from physx_core.testing.subject import Check

_MODULES = {
    "environment": "environment",
    "network": "network",
    "optimization": "optimization",
    "transformation": "transformation",
    "visualizer": "visualizer",
    "backend": "backend.checks",
    "launcher": "launcher",
    "buffer": "buffer",
    "sampler": "sampler",
}


def checks_of(kind: str) -> Mapping[str, Check]:
    """Return the checks of a kind of component by name; names are sentences about the component."""
    module = importlib.import_module(f"physx_core.testing.{_MODULES[kind]}")
    checks: Mapping[str, Check] = module.CHECKS
    return checks
