"""Writes what a run found to one HTML page.

A page consists of sections, which are components: a plugin adds one with the hook
``physx_report_sections``.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
