"""View: which rows of stored data to learn from, in which form, order and parts; a plain value."""

from __future__ import annotations

from typing import Any

from physx_core.config import configuration
from physx_core.views.batches import Batches
from physx_core.views.options import ViewOptions


@configuration
class View(ViewOptions):
    """What a network learns from: rows or windows of stored data, which of them, in which order.

    A view is a value: it reads nothing. `open` binds it to the data.
    """

    def open(self, batch_size: int, seed: int = 0, **options: Any) -> Batches:
        """Return batches of the data as they are now: see `Batches`, which has the options."""
        return Batches(self, batch_size, seed, **options)
