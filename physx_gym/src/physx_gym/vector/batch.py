"""SharedBatch: actions and results of all environments, in memory that the processes share."""

from __future__ import annotations

import math
import mmap
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np

from physx_core import Field
from physx_core.typing import Array, Batch

INFO_BYTES = 512
"""Bytes reserved for the info of an environment."""
COMMAND = -1
"""Entry of a queue that represents a command, which the worker receives as a message."""
END = -1
"""Value of `SharedBatch.asked` that tells a worker to exit."""
NEVER = 1 << 62
"""A number of entries that is never reached."""


@dataclass
class EnvArrays:
    """Arrays of environments: their inputs and their results.

    Attributes:
        first: Number of the first environment.
        actions: For each field of an action, an array of shape (environments, *shape).
        observations: The same for each field of an observation.
        finals: The same for the last observations of episodes that are over, if they are kept.
        rewards: Shape (environments,).
        terminated: Shape (environments,).
        truncated: Shape (environments,).
        kinds: The form of each info: see `InfoKind`; shape (environments,).
        infos: The bytes of each info, shape (environments, INFO_BYTES).
    """

    first: int
    actions: Batch
    observations: Batch
    finals: Batch
    rewards: Array
    terminated: Array
    truncated: Array
    kinds: Array
    infos: Array


_Layout: TypeAlias = tuple[tuple[int, ...], Any]

_COUNTERS = ("asked", "done", "idle", "sent")
_LINE = 64  # bytes of a processor's cache line: different writers use different ones


class SharedBatch(EnvArrays):
    """Arrays of all environments, and a queue for each worker, in memory that processes share.

    The rows of an environment belong to its worker from the request for a step until that step is
    done, and otherwise to the process with the vector environment. A queue is a ring: entry n,
    counted from 0 since the start, is at ``n % capacity``. It is the index, among the worker's own
    environments, of the one to step, or `COMMAND`.

    Attributes:
        capacity: Number of entries that fit into a queue.
        queues: Shape (workers, capacity).
        asked: For each worker, how many entries its queue has had, or `END`.
        done: For each worker, how many of them it has finished.
        idle: For each worker, whether it sleeps and must be woken.
        sent: For each worker, how many messages it has sent.
        awaited: How many entries all workers together must finish before the process with the
            vector environment must be woken; `NEVER` if it does not sleep. One element.
    """

    def __init__(
        self,
        file: int,
        shares: Sequence[int],
        observations: Sequence[Field],
        actions: Sequence[Field],
        *,
        has_finals: bool,
    ) -> None:
        """Map the memory.

        Args:
            file: Descriptor of a file, which is enlarged if it is too small.
            shares: Number of environments of each worker.
            observations: Fields of an observation.
            actions: Fields of an action.
            has_finals: Whether last observations are kept.
        """
        count, workers = sum(shares), len(shares)
        self.capacity = max(shares) + 1  # a command besides a step of each environment
        arrays = _map(
            file,
            {
                "rewards": ((count,), "float64"),
                "terminated": ((count,), "bool"),
                "truncated": ((count,), "bool"),
                "kinds": ((count,), "int16"),
                "infos": ((count, INFO_BYTES), "uint8"),
                "queues": ((workers, self.capacity), "int64"),
                **dict.fromkeys(_COUNTERS, ((workers, _LINE // 8), "int64")),
                "awaited": ((1,), "int64"),
                **_table(count, actions),
                **_table(count, observations),
                **(_table(count, observations, "final ") if has_finals else {}),
            },
        )
        self.queues = arrays["queues"]
        super().__init__(
            0,
            {each.name: arrays[each.name] for each in actions},
            {each.name: arrays[each.name] for each in observations},
            {each.name: arrays[f"final {each.name}"] for each in observations if has_finals},
            *(arrays[name] for name in ("rewards", "terminated", "truncated", "kinds", "infos")),
        )
        # A memoryview reads and writes a number in half the time an array takes.
        self.asked, self.done, self.idle, self.sent = (
            memoryview(cast(Any, arrays[name][:, 0])) for name in _COUNTERS
        )
        self.awaited = memoryview(cast(Any, arrays["awaited"]))


def _table(count: int, fields: Sequence[Field], prefix: str = "") -> dict[str, _Layout]:
    return {prefix + each.name: ((count, *(each.shape or ())), each.dtype) for each in fields}


def _map(file: int, table: dict[str, _Layout]) -> dict[str, Array]:
    """Return arrays in a file that is mapped, by name; `table` has their shapes and types."""
    places, size = {}, 0
    for name, (shape, kind) in table.items():
        places[name] = size
        size += -(-math.prod(shape) * np.dtype(kind).itemsize // _LINE) * _LINE
    if os.fstat(file).st_size < size:
        os.ftruncate(file, size)
    memory = mmap.mmap(file, size)
    return {
        name: np.ndarray(shape, kind, memory, places[name]) for name, (shape, kind) in table.items()
    }
