"""Pipelines: data generation, training, prediction, and replay.

The pipelines to run or to derive from, and `load_learner`, which loads a trained network.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
