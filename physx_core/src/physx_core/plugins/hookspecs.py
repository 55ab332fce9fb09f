"""The nine hooks that a plugin may implement.

Each returns a dictionary from component names to components: a class, a function that takes the
component's keyword arguments and returns it, or a reference ``"package.module:Name"`` that is
imported when the component is first used.

The names of plugins and components consist of letters, digits, "_", "-", and ".", and do not start
with "-" or ".". A component's name may consist of several such parts separated by "/", like
Gymnasium ids. The component ``module`` adapts what the user has from another library: of the
reference ``"plugin/package.module:Name"`` it gets ``"package.module:Name"`` as its argument
``module``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pluggy

from physx_core.plugins.entries import PLUGINS

Components = dict[str, type[Any] | Callable[..., Any] | str]
"""The return value of a hook: name to class, to a function that creates the component, or to its
reference ``"package.module:Class"``, which is imported on request."""

_NAME = r"\w[\w.-]*"

hookspec = pluggy.HookspecMarker(PLUGINS)
hookimpl = pluggy.HookimplMarker(PLUGINS)
"""Marks a plugin's function as the implementation of the hook with the same name."""

ADAPTER = "module"
"""Name of the component that adapts what other libraries define, and of its argument."""

KINDS = {
    "environment": "physx_environments",
    "network": "physx_networks",
    "optimization": "physx_optimizations",
    "transformation": "physx_transformations",
    "visualizer": "physx_visualizers",
    "backend": "physx_backends",
    "launcher": "physx_launchers",
    "buffer": "physx_buffers",
    "sampler": "physx_samplers",
}
"""Kind of component to the hook that returns it."""


def is_plugin_name(name: Any) -> bool:
    """Return whether a plugin may have this name."""
    return isinstance(name, str) and re.fullmatch(_NAME, name) is not None


def is_component_name(name: Any) -> bool:
    """Return whether a component may have this name."""
    return isinstance(name, str) and re.fullmatch(f"{_NAME}(/{_NAME})*", name) is not None


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


@hookspec
def physx_buffers() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Buffer` by name."""


@hookspec
def physx_samplers() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Sampler` by name."""
