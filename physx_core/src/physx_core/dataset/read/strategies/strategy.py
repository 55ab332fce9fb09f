"""Read strategies: how batches are read; chosen by the fields' sizes and the free memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias, cast, get_args

from physx_core.dataset.read.strategies import memory
from physx_core.errors import ConfigError, listed
from physx_core.fields import Field

Strategy: TypeAlias = Literal["memory", "disk exact", "disk windowed"]
"""How batches are read.

- ``memory``: the fields are read into memory once; a shuffled epoch is an exact permutation.
- ``disk exact``: the same permutation, read row by row; the system is asked to prefetch upcoming
  rows.
- ``disk windowed``: blocks of rows are read in random order, and the rows of 64 blocks at a time
  are shuffled. Every row occurs once per epoch, but rows of the same block stay close together.
"""
Choice: TypeAlias = Strategy | Literal["auto"]


class ReadingOrder(NamedTuple):
    """What the order of shuffled rows depends on, besides the seed.

    Attributes:
        strategy: How the rows are read; ``memory`` and ``disk exact`` give the same order.
        block: Number of rows in a block of ``disk windowed``.
    """

    strategy: Strategy
    block: int


LARGE_ROW = 4096
"""Bytes from which reading a single row pays off: a disk never reads less at a time."""

_SHARE = 0.5


def choose_strategy(missing: int, fields: Sequence[Field]) -> Strategy:
    """Choose a read strategy.

    Args:
        missing: Bytes of the fields that are not in memory yet.
        fields: The fields to read together.
    """
    if not missing or missing <= memory_budget():
        return "memory"
    row_nbytes = sum(field.nbytes for field in fields)
    return "disk exact" if row_nbytes >= LARGE_ROW else "disk windowed"


def memory_budget() -> int:
    """Return the number of bytes of memory that rows may take now."""
    return int(_SHARE * memory.available_memory())


def check_strategy(choice: str) -> Strategy | None:
    """Return the strategy of the given name; None for ``auto``."""
    if choice == "auto":
        return None
    if choice in get_args(Strategy):
        return cast(Strategy, choice)
    names = listed(["auto", *get_args(Strategy)])
    raise ConfigError(f'There is no reading strategy "{choice}". Strategies: {names}.')
