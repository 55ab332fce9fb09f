"""Datasets: samples in HDF5 partitions, written at disk speed and crash-safe at all times.

The format is documented in `physx_core.dataset.store`: `partition.format` and `manifest`.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
