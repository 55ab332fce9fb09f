"""The seven hooks that a plugin may implement.

Each returns a dictionary from a component's name to the component: a class, a function that takes
the component's keyword arguments and returns it, or a reference ``"package.module:Name"`` that is
imported when the component is first used.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pluggy

from physx_core.plugins.entries import PLUGINS

Components = dict[str, type[Any] | Callable[..., Any] | str]

hookspec = pluggy.HookspecMarker(PLUGINS)
hookimpl = pluggy.HookimplMarker(PLUGINS)

KINDS = {
    "environment": "physx_environments",
    "network": "physx_networks",
    "optimization": "physx_optimizations",
    "transformation": "physx_transformations",
    "visualizer": "physx_visualizers",
    "backend": "physx_backends",
    "launcher": "physx_launchers",
}
"""Kind of component to the hook that returns it."""


@hookspec
def physx_environments() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Environment` by name."""


@hookspec
def physx_networks() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Network` by name."""


@hookspec
def physx_optimizations() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Optimization` by name."""


@hookspec
def physx_transformations() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Transformation` by name."""


@hookspec
def physx_visualizers() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Visualizer` by name."""


@hookspec
def physx_backends() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Backend` by name."""


@hookspec
def physx_launchers() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Launcher` by name."""
