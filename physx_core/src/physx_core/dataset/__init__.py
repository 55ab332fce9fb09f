"""Datasets: samples in HDF5 partitions, written at disk speed and crash-safe at all times.

The format is documented in `physx_core.dataset.store`: `partition.format` and `manifest`.
"""

from __future__ import annotations

from physx_core.dataset.dataset import Dataset
from physx_core.dataset.read.episodes import Episode
from physx_core.dataset.read.splits import Subset

__all__ = ["Dataset", "Episode", "Subset"]
