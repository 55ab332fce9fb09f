"""The demo of physx, which comes with the distribution ``physx``."""

from __future__ import annotations

from importlib.metadata import version

__version__ = version("physx")
