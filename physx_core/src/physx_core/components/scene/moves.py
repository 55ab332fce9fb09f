"""Moves: consecutive moves of bodies, sent as one event."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.components.scene.event import Event
from physx_core.components.scene.options import LARGEST
from physx_core.typing import Array

POSE = {"position": 3, "orientation": 4}
"""Options that many objects change in every step, and how many numbers each has."""
_TURN = POSE["orientation"]


class Moves:
    """Consecutive moves of bodies of one kind.

    Attributes:
        kind: Their kind.
        options: The options that each of them changes, in the order of `POSE`.
    """

    def __init__(self, kind: str, options: Sequence[str]) -> None:
        self.kind, self.options = kind, options
        self._names: list[str] = []
        self._floats: list[float] = []
        self._first, self._second = options[0], options[1] if len(options) == 2 else None
        self._count = sum(POSE[option] for option in options)

    def add(self, name: str, changes: Mapping[str, Array]) -> bool:
        """Add a move, in few operations; return False if it does not fit the options."""
        if len(changes) != len(self.options):
            return False
        try:
            row = changes[self._first].tolist()
            if self._second is not None:
                more = changes[self._second].tolist()
                if len(more) != _TURN:
                    return False
                row += more
            if len(row) != self._count or not math.hypot(*row) < LARGEST:
                return False
        except (KeyError, AttributeError, TypeError, OverflowError):
            return False
        self._names.append(name)
        self._floats += row
        return True

    def event(self) -> Event:
        """Return one event with all moves."""
        count, begin = len(self._names), 0
        packed = struct.pack(f"{len(self._floats)}f", *self._floats)  # 3 times as fast as NumPy
        rows = np.frombuffer(packed, np.float32).reshape(count, -1)
        values: dict[str, Any] = {}
        for option in self.options:
            end = begin + POSE[option]
            values[option] = rows[0, begin:end] if count == 1 else rows[:, begin:end]
            begin = end
        return Event("update", self.kind, tuple(self._names), values)
