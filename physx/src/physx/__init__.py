"""physx as a whole: the command ``physx``, its demo, and extras that install its packages."""

from __future__ import annotations

from importlib.metadata import version

__version__ = version("physx")
