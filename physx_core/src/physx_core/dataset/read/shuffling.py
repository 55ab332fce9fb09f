"""Orders in which an epoch visits items, made of the items' number and a key by integer arithmetic.

No machine, library version, free memory or choice of fields changes them.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from hashlib import blake2b
from typing import Any, Literal, NamedTuple, TypeAlias, cast, get_args

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ConfigError, listed
from physx_core.typing import Index

OrderName: TypeAlias = Literal["exact", "blocks", "stored"]
"""In which order an epoch visits its items.

- ``exact``: all orders are equally likely.
- ``blocks``: blocks of 64 kB of consecutive items come in random order, and the items of 256 blocks
  at a time are shuffled, so that data larger than memory are read in long pieces. Each batch draws
  from 256 places; items of the same block stay close together.
- ``stored``: the order of the rows.
"""
LARGE_ROW = 4096
"""Bytes from which reading a single row pays off: a disk never reads less at a time."""
_MOST_SORTED = 2**21
_BLOCK, _WINDOW, _MOST_BLOCKS = 2**16, 256, 2**21
_CHUNK = 2**24  # bytes that are read at once where blocks do not say so
_SLAB = 2**16
_ROUNDS = 12  # of the lazy permutation; with fewer, not all orders are equally likely
_STEP, _FIRST, _SECOND = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB  # splitmix64

_STEP32, _FIRST32, _SECOND32, _MASK32 = 0x9E3779B9, 0x85EBCA6B, 0xC2B2AE35, 2**32 - 1  # murmur3

Numbers: TypeAlias = NDArray[np.uint64]


class Chunk(NamedTuple):
    """Consecutive positions of an order, whose items are best read together.

    Attributes:
        start: The first position.
        stop: The position after the last one.
        items: The items, in an order that is good to read, shape (stop - start,).
        places: Which of `items` each position visits; None: in this order.
    """

    start: int
    stop: int
    items: Index
    places: Index | None


class ItemOrder(ABC):
    """An order of the items from 0 to ``count - 1``.

    Attributes:
        count: Number of items.
    """

    def __init__(self, count: int) -> None:
        """Store the number of items."""
        self.count = count

    @abstractmethod
    def chunk(self, position: int) -> Chunk:
        """Return the chunk with a position."""

    def items(self, start: int, stop: int) -> Index:
        """Return the items at some positions, shape (stop - start,)."""
        parts = []
        while start < stop:
            chunk = self.chunk(start)
            inside = slice(start - chunk.start, min(stop, chunk.stop) - chunk.start)
            drawn = (
                chunk.items[inside] if chunk.places is None else chunk.items[chunk.places[inside]]
            )
            parts.append(drawn)
            start += len(drawn)
        return np.concatenate(parts) if parts else np.zeros(0, np.intp)


class StoredOrder(ItemOrder):
    """The items as they are."""

    def __init__(self, count: int, row_nbytes: int) -> None:
        """Read chunks of some megabytes.

        Args:
            count: Number of items.
            row_nbytes: Bytes of an item.
        """
        super().__init__(count)
        self._size = max(1, _CHUNK // 4 // max(1, row_nbytes))

    def chunk(self, position: int) -> Chunk:
        """Return the chunk with a position."""
        start = position // self._size * self._size
        stop = min(start + self._size, self.count)
        return Chunk(start, stop, np.arange(start, stop), None)


class ExactOrder(ItemOrder):
    """A random order, all equally likely; of many items computed as it is needed."""

    def __init__(self, count: int, row_nbytes: int, key: int) -> None:
        """Choose the order.

        Args:
            count: Number of items.
            row_nbytes: Bytes of an item.
            key: Determines the order, with `count`.
        """
        super().__init__(count)
        self._key, self._size = key, max(1, _CHUNK // max(1, row_nbytes))
        self.is_sorted = count <= _MOST_SORTED
        self._slab: tuple[int, Index] = (-1, np.zeros(0, np.intp))

    @cached_property
    def all(self) -> Index:
        """The items in order; of not too many: see `is_sorted`."""
        return permutation(self.count, self._key)

    def chunk(self, position: int) -> Chunk:
        """Return the chunk with a position."""
        start = position // self._size * self._size
        drawn = self.items(start, min(start + self._size, self.count))
        items = np.sort(drawn)
        return Chunk(start, start + len(drawn), items, items.searchsorted(drawn))

    def items(self, start: int, stop: int) -> Index:
        """Return the items at some positions, shape (stop - start,)."""
        if self.is_sorted:
            return self.all[start:stop]
        if start >= stop:
            return np.zeros(0, np.intp)
        first, last = start // _SLAB, (stop - 1) // _SLAB
        slabs = np.concatenate([self._lazy(number) for number in range(first, last + 1)])
        return slabs[start - first * _SLAB : stop - first * _SLAB]

    def _lazy(self, number: int) -> Index:
        if self._slab[0] != number:
            positions = np.arange(number * _SLAB, min((number + 1) * _SLAB, self.count))
            self._slab = number, scatter(positions, self.count, self._key)
        return self._slab[1]


class BlockOrder(ItemOrder):
    """Blocks of consecutive items in random order, shuffled in windows of many blocks."""

    def __init__(self, count: int, row_nbytes: int, key: int) -> None:
        """Choose the order.

        Args:
            count: Number of items.
            row_nbytes: Bytes of an item.
            key: Determines the order, with the other arguments.
        """
        super().__init__(count)
        size = max(1, _BLOCK // max(1, row_nbytes), -(-count // _MOST_BLOCKS))
        blocks = permutation(-(-count // size), key)
        self._starts = blocks * size
        self._sizes = np.minimum(size, count - self._starts)
        self._key = key
        self._ends = np.cumsum(np.add.reduceat(self._sizes, np.arange(0, len(blocks), _WINDOW)))

    def chunk(self, position: int) -> Chunk:
        """Return the window with a position."""
        number = int(self._ends.searchsorted(position, "right"))
        stop = int(self._ends[number])
        which = slice(number * _WINDOW, (number + 1) * _WINDOW)
        starts, sizes = self._starts[which], self._sizes[which]
        begins = np.cumsum(sizes) - sizes
        items = np.repeat(starts - begins, sizes) + np.arange(int(sizes.sum()))
        places = permutation(len(items), key_of(self._key, number))
        return Chunk(stop - len(items), stop, items, places)


def make_order(name: OrderName, count: int, row_nbytes: int, key: int) -> ItemOrder:
    """Return an order.

    Args:
        name: Its name.
        count: Number of items.
        row_nbytes: Bytes of a stored item; with ``blocks`` the order depends on it.
        key: Determines the order, with the other arguments.
    """
    if name == "stored":
        return StoredOrder(count, row_nbytes)
    return (ExactOrder if name == "exact" else BlockOrder)(count, row_nbytes, key)


def choose_order(count: int, row_nbytes: int) -> OrderName:
    """Return the order in which items are shuffled if none is named: by the data alone."""
    return "exact" if count <= _MOST_SORTED or row_nbytes >= LARGE_ROW else "blocks"


def check_order(name: str) -> OrderName:
    """Return the order of the given name."""
    names = get_args(OrderName)
    if name not in names:
        raise ConfigError(f'There is no order "{name}". Orders: {listed(names)}.')
    return cast(OrderName, name)


def scramble(numbers: Numbers, key: int) -> Numbers:
    """Replace numbers, in place, by others that look random; no two become equal."""
    numbers ^= np.uint64(key)
    for factor, shift in ((_STEP, 32), (_FIRST, 29), (_SECOND, 32)):
        numbers *= np.uint64(factor)
        numbers ^= numbers >> np.uint64(shift)
    numbers += np.uint64(key)
    numbers *= np.uint64(_FIRST)
    numbers ^= numbers >> np.uint64(31)
    return numbers


def key_of(*numbers: int | Sequence[int]) -> int:
    """Return a key of 64 bits that depends on all bits of some numbers and lists of numbers."""
    several: Sequence[Any] = numbers
    plain = [[int(e) for e in each] if np.ndim(each) else int(each) for each in several]
    return int.from_bytes(blake2b(repr(plain).encode(), digest_size=8).digest(), "little")


def permutation(count: int, key: int) -> Index:
    """Return the numbers from 0 to ``count - 1`` in an order that depends on `count` and `key`.

    Args:
        count: How many numbers there are, at most 2**32.
        key: 64 bits.
    """
    numbers = np.arange(count, dtype=np.uint32)
    hashed = numbers * np.uint32(_STEP32) + np.uint32(key & _MASK32)
    for factor, shift in ((_FIRST32, 16), (_SECOND32, 13), (key >> 32 | 1, 15)):
        hashed ^= hashed >> np.uint32(shift)
        hashed *= np.uint32(factor)
    hashed ^= hashed >> np.uint32(16)
    sorted_pairs = hashed.astype(np.uint64)
    sorted_pairs <<= np.uint64(32)
    sorted_pairs |= numbers  # sorting these is twice as fast as argsort; no two hashes are equal
    sorted_pairs.sort()
    sorted_pairs &= np.uint64(_MASK32)
    return sorted_pairs.astype(np.intp, copy=False)


def scatter(positions: Index, count: int, key: int) -> Index:
    """Return the numbers at some positions of a permutation, without computing it as a whole.

    A Feistel network on pairs of digits; what falls outside is encrypted again.

    Args:
        positions: Positions, shape (n,).
        count: How many numbers there are, less than 2**62.
        key: Determines the permutation, with `count`.
    """
    high = math.isqrt(max(0, count - 1)) + 1
    low = -(-count // high)
    keys = [key_of(key, turn) for turn in range(_ROUNDS)]
    found = positions.astype(np.uint64)
    outside: Any = slice(None)
    while True:
        digits = [*np.divmod(found[outside], np.uint64(low))]
        for turn, each in enumerate(keys):
            mine, base = turn % 2, (high, low)[turn % 2]
            digits[mine] += _below(scramble(digits[1 - mine].copy(), each), base)
            digits[mine] -= np.uint64(base) * (digits[mine] >= np.uint64(base))
        found[outside] = digits[0] * np.uint64(low) + digits[1]
        outside = np.flatnonzero(found >= np.uint64(count))
        if not len(outside):
            return found.astype(np.intp)


def _below(hashed: Numbers, base: int) -> Numbers:
    """Return numbers below a base, which is at most 2**32, from the upper halves of hashes."""
    hashed >>= np.uint64(32)
    hashed *= np.uint64(base)
    hashed >>= np.uint64(32)
    return hashed
