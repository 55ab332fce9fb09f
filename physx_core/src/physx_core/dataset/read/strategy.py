"""Policies: how batches are read, chosen from the sizes of the fields and the free memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias, get_args

from physx_core.dataset.read import memory
from physx_core.errors import ConfigError, listed
from physx_core.fields import Field

Policy: TypeAlias = Literal["memory", "disk exact", "disk windowed"]
"""How batches are read.

- ``memory``: the fields are read into memory once; a shuffled epoch is an exact permutation.
- ``disk exact``: rows are read one by one, the system being told early which come next; the same
  permutation.
- ``disk windowed``: blocks of rows are read in random order, and the rows of 64 blocks at a time
  are shuffled. Every row comes once in an epoch, but rows of the same block come near each other.
"""
Choice: TypeAlias = Policy | Literal["auto"]

LARGE_ROW = 4096
"""Bytes from which a row is worth reading alone: a disk gives no less."""

_SHARE = 0.5


def choose(missing: int, fields: Sequence[Field]) -> Policy:
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


def check(policy: str) -> Policy | None:
    """Return a policy that was asked for by name; None for ``auto``.

    Raises:
        ConfigError: There is no such policy.
    """
    if policy == "auto":
        return None
    for known in get_args(Policy):
        if policy == known:
            return known  # type: ignore[no-any-return]
    raise ConfigError(
        f'There is no reading policy "{policy}". Policies: {listed(["auto", *get_args(Policy)])}.'
    )
