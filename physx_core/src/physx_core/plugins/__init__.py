"""Plugins: components of pip-installed packages, found by the name of their entry point.

A plugin is a module that an entry point of the group ``physx`` names. It implements some of the
hooks in `physx_core.plugins.hookspecs` with the marker `hookimpl`.
"""

from __future__ import annotations

from physx_core.config import reference_of
from physx_core.plugins.hookspecs import GROUP, KINDS, Components, hookimpl
from physx_core.plugins.references import imported, resolve
from physx_core.plugins.registry import Plugin, PluginInfo, available, load

__all__ = [
    "GROUP",
    "KINDS",
    "Components",
    "Plugin",
    "PluginInfo",
    "available",
    "hookimpl",
    "imported",
    "load",
    "reference_of",
    "resolve",
]
