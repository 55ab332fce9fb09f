"""The hooks of the core that a plugin may implement; packages may add others: see `kinds`.

Each returns a dictionary from component names to components: a class, a function that takes the
component's keyword arguments and returns it, or a reference ``"package.module:Name"`` that is
imported when the component is first used.

The names of plugins and components consist of letters, digits, "_", "-", and ".", and do not start
with "-" or ".". A component's name may consist of several such parts separated by "/", like
Gymnasium ids. The component ``module`` adapts what the user has from another library: of the
reference ``"plugin/package.module:Name"`` it gets ``"package.module:Name"`` as its argument
``module``. The environment ``log`` simulates the episode in a log again, whose path it gets as its
argument ``path``, and fails if it cannot.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, TypeVar

import pluggy

from physx_core.plugins.entries import PLUGINS

Components = dict[str, type[Any] | Callable[..., Any] | str]
"""The return value of a hook: name to class, to a function that creates the component, or to its
reference ``"package.module:Class"``, which is imported on request."""

Hook = TypeVar("Hook", bound=Callable[[], Components])

_NAME = r"\w[\w.-]*"

hookspec = pluggy.HookspecMarker(PLUGINS)
hookimpl = pluggy.HookimplMarker(PLUGINS)
"""Marks a plugin's function as the implementation of the hook with the same name."""

MARK = "physx_kind"
"""Attribute of a hook's function that says what `kind_hook` was told."""
ADAPTER = "module"
"""Name of the component that adapts what other libraries define, and of its argument."""
LOG = "log"
"""Name of the environment that simulates the episode in a log again."""


def kind_hook(base: str, *, is_instance: bool = False) -> Callable[[Hook], Hook]:
    """Mark a function ``physx_<kind>s`` as the hook that returns components of a kind.

    A package that adds a kind names the function's module in its entry points: ``[project.
    entry-points."physx.hookspecs"]``, ``physx_<kind>s = "package.module"``.

    Args:
        base: See `kinds.Kind`.
        is_instance: See `kinds.Kind`.
    """

    def mark(hook: Hook) -> Hook:
        marked = hookspec(hook)
        vars(marked)[MARK] = base, is_instance
        return marked

    return mark


def is_plugin_name(name: Any) -> bool:
    """Return whether a plugin may have this name."""
    return isinstance(name, str) and re.fullmatch(_NAME, name) is not None


def is_component_name(name: Any) -> bool:
    """Return whether a component may have this name."""
    return isinstance(name, str) and re.fullmatch(f"{_NAME}(/{_NAME})*", name) is not None


@kind_hook("physx_core.components:Environment")
def physx_environments() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Environment` by name."""


@kind_hook("physx_core.components:Network")
def physx_networks() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Network` by name."""


@kind_hook("physx_core.components:Optimization")
def physx_optimizations() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Optimization` by name."""


@kind_hook("physx_core.components:Transformation")
def physx_transformations() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Transformation` by name."""


@kind_hook("physx_core.components:Observer")
def physx_visualizers() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Visualizer` by name."""


@kind_hook("physx_core.components:Launcher")
def physx_launchers() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Launcher` by name."""


@kind_hook("physx_core.components:Buffer")
def physx_buffers() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Buffer` by name."""


@kind_hook("physx_core.components:Sampler")
def physx_samplers() -> Components:  # type: ignore[empty-body]
    """Return subclasses of `physx_core.Sampler` by name."""


@kind_hook("physx_core.components:Evaluation")
def physx_evaluations() -> Components:  # type: ignore[empty-body]
    """Return instances of `physx_core.components.Evaluation` by name."""
