"""Random streams by number: one generator, set in place to the stream of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Words = NDArray[Any]
_U1, _LOW = np.uint64(1), np.uint64(2**32 - 1)
_FACTOR = np.uint64(2549297995355413924), np.uint64(4865540595714422341)  # of PCG64


class NumberedStreams:
    """The random streams of a run's episodes: Philox, with the number as part of its counter.

    Attributes:
        generator: At first it is at a stream that is none of those by number, and the same for
            every caller with the same seed. It cannot spawn others, since what these draw would
            depend on how often that was done before.
    """

    def __init__(self, seed: int | Sequence[int] | None) -> None:
        """Derive the key of the streams from the seed of a run."""
        key = np.random.SeedSequence(seed).generate_state(2, np.uint64)
        self._bits: Any = np.random.Philox(key=key, counter=[0, 0, 1, 0])
        self._counter = [0, 0, 0, 0]
        # NumPy reads one number after the other, from lists in less than half the time.
        self._state: dict[str, Any] = {
            **self._bits.state,
            "state": {"key": key.tolist(), "counter": self._counter},
            "buffer": [0, 0, 0, 0],
        }
        self.generator = np.random.Generator(self._bits)

    def seek(self, number: int) -> None:
        """Set the generator in place to the beginning of a stream; each has 2^194 numbers."""
        self._counter[3] = number
        self._bits.state = self._state


def first_numbers(
    entropy: int | Sequence[int], numbers: range, stream: int, size: int
) -> NDArray[np.float64]:
    """Return the first random numbers of many generators at once, shape (numbers, size).

    Row k has the bits of ``default_rng(SeedSequence(entropy, spawn_key=(numbers[k], stream)))
    .random(size)``. To create one generator takes 12 us, which is much if all it does is to draw a
    set of parameters. NumPy guarantees that `SeedSequence` and `PCG64` stay as they are.

    Args:
        entropy: Seed of the run.
        numbers: Numbers of the streams.
        stream: Purpose of the streams, below 2^32.
        size: How many numbers of each.
    """
    found = np.empty((len(numbers), size))
    if numbers and numbers[-1] >= 2**32:  # they would be two words of the key
        for row, number in zip(found, numbers, strict=True):
            key = np.random.SeedSequence(entropy, spawn_key=(number, stream))
            row[:] = np.random.default_rng(key).random(size)
        return found
    words = _seed_words(entropy, np.array(numbers, np.uint32), stream)
    seeds = [words[place] | words[place + 1] << np.uint64(32) for place in range(0, 8, 2)]
    state, step = seeds[:2], [seeds[2] << _U1 | seeds[3] >> np.uint64(63), seeds[3] << _U1 | _U1]
    state = _advance(_add(state, step), step)
    for element in range(size):
        high, low = state = _advance(state, step)
        turn, mixed = high >> np.uint64(58), high ^ low
        turned = mixed >> turn | mixed << (-turn & np.uint64(63))
        found[:, element] = (turned >> np.uint64(11)) * 2.0**-53
    return found


def _seed_words(entropy: int | Sequence[int], numbers: Words, stream: int) -> list[Words]:
    """Return the eight words by which `SeedSequence` seeds a generator, in 64 bits each."""
    pool: Any = list(np.random.SeedSequence(entropy).pool[:, np.newaxis])
    parts = [entropy] if isinstance(entropy, int) else list(entropy)
    length = sum(max(1, -(-int(part).bit_length() // 32)) for part in parts)
    factor = 0x43B0D7E5 * pow(0x931E8875, 16 + 4 * max(0, length - 4), 2**32)
    for word in (numbers, np.full_like(numbers, stream)):
        for place in range(4):
            hashed, factor = _hash(word, factor, 0x931E8875)
            mixed = np.uint32(0xCA01F9DD) * pool[place] - np.uint32(0x4973F715) * hashed
            pool[place] = mixed ^ mixed >> np.uint32(16)
    words, factor = [], 0x8B51F9DD
    for place in range(8):
        word, factor = _hash(pool[place % 4], factor, 0x58F38DED)
        words.append(word.astype(np.uint64))
    return words


def _hash(words: Words, factor: int, multiplier: int) -> tuple[Words, int]:
    """Return hashes of words, and the factor of the next ones."""
    following = factor * multiplier % 2**32
    hashed = (words ^ np.uint32(factor % 2**32)) * np.uint32(following)
    return hashed ^ hashed >> np.uint32(16), following


def _advance(state: list[Words], step: list[Words]) -> list[Words]:
    """Return the next states of PCG64, each as its high and its low 64 bits."""
    high, low = state
    a, b = low >> np.uint64(32), low & _LOW
    c, d = _FACTOR[1] >> np.uint64(32), _FACTOR[1] & _LOW
    middle = a * d + (b * d >> np.uint64(32))
    other = b * c + (middle & _LOW)
    carry = a * c + (middle >> np.uint64(32)) + (other >> np.uint64(32))
    return _add([carry + high * _FACTOR[1] + low * _FACTOR[0], low * _FACTOR[1]], step)


def _add(one: list[Words], other: list[Words]) -> list[Words]:
    """Return the sums of numbers of 128 bits."""
    low = one[1] + other[1]
    return [one[0] + other[0] + (low < one[1]), low]
