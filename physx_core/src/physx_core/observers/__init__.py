"""Observers of a running pipeline: progress bar, statistics, and viewers."""

from __future__ import annotations

from physx_core.observers.chosen import statistics_observers
from physx_core.observers.composite import Observers
from physx_core.observers.progress import ProgressBar
from physx_core.observers.scalars_file import FIELDS, REPORT_SECONDS, ScalarsFile, read_scalars

__all__ = [
    "FIELDS",
    "REPORT_SECONDS",
    "Observers",
    "ProgressBar",
    "ScalarsFile",
    "read_scalars",
    "statistics_observers",
]
