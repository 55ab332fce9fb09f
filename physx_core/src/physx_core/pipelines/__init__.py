"""Pipelines: data generation, training, prediction, and replay.

The pipelines to run or to derive from; `load_learner`, which loads a trained network; and
`read_drawn_rows`, which returns the rows in each batch of a training.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
