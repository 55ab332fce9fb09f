"""Observers: progress, statistics and viewers look on while a pipeline runs."""

from __future__ import annotations

from physx_core.observers.progress import ProgressBar
from physx_core.observers.scalars_file import ScalarsFile
from physx_core.observers.several import Observers

__all__ = ["Observers", "ProgressBar", "ScalarsFile"]
