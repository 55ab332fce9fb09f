"""Datasets: samples in HDF5 partitions, written at the speed of the disk and safe at any moment.

`physx_core.dataset.store` describes the format: `partition.format` and `manifest`.
"""

from __future__ import annotations

from physx_core.dataset.dataset import Dataset
from physx_core.dataset.read.episodes import Episode
from physx_core.dataset.read.splits import Subset

__all__ = ["Dataset", "Episode", "Subset"]
