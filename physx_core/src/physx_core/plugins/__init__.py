"""Plugins: components of pip-installed packages, selected by the name of their entry point.

A plugin is a module named by an entry point in the group ``physx``. It implements some of the hooks
in `physx_core.plugins.hookspecs`, or of those that other packages add (see `kind_hook`), and marks
them with `hookimpl`.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
