"""Strategies: how batches are read, chosen from the sizes of the fields and the free memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias, get_args

from physx_core.dataset.read import memory
from physx_core.errors import ConfigError, listed
from physx_core.fields import Field

Strategy: TypeAlias = Literal["memory", "disk exact", "disk windowed"]
"""How batches are read.

- ``memory``: the fields are read into memory once; a shuffled epoch is an exact permutation.
- ``disk exact``: rows are read one by one, the system being told early which come next; the same
  permutation.
- ``disk windowed``: blocks of rows are read in random order, and the rows of 64 blocks at a time
  are shuffled. Every row comes once in an epoch, but rows of the same block come near each other.
"""
Choice: TypeAlias = Strategy | Literal["auto"]

LARGE_ROW = 4096
"""Bytes from which a row is worth reading alone: a disk gives no less."""

_SHARE = 0.5


def choose(missing: int, fields: Sequence[Field]) -> Strategy:
    """Choose how to read.

    Args:
        missing: Bytes of the fields that are not in memory yet.
        fields: The fields to read together.
    """
    if not missing or missing <= budget():
        return "memory"
    row_nbytes = sum(field.nbytes for field in fields)
    return "disk exact" if row_nbytes >= LARGE_ROW else "disk windowed"


def budget() -> int:
    """Return how many bytes rows may take in memory now."""
    return int(_SHARE * memory.available_memory())


def check(strategy: str) -> Strategy | None:
    """Return a strategy that was asked for by name; None for ``auto``.

    Raises:
        ConfigError: There is no such strategy.
    """
    if strategy == "auto":
        return None
    for known in get_args(Strategy):
        if strategy == known:
            return known  # type: ignore[no-any-return]
    known_names = listed(["auto", *get_args(Strategy)])
    raise ConfigError(f'There is no reading strategy "{strategy}". Strategies: {known_names}.')
