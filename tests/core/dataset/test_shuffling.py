"""Orders by integer arithmetic: permutations, all equally likely, the same everywhere."""

import itertools
import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from physx_core.dataset.read import shuffling
from physx_core.dataset.read.shuffling import key_of, make_order, permutation, scatter

COUNTS = st.integers(1, 400)
KEYS = st.integers(0, 2**64 - 1)
KEY_OF_0 = 11243728523470438572
PERMUTATION = [5, 8, 9, 1, 2, 3, 4, 7, 6, 0]
SCATTERED = [7, 6, 1, 3, 9, 4, 5, 0, 8, 2]
BLOCKS = [4, 1, 37, 36, 5, 31, 30, 35, 2, 3, 32, 39]


@pytest.fixture(autouse=True, scope="module")
def small():
    """Few items make a chunk, a block, a window, a slab, or too many to sort."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (
            *(("_CHUNK", 1000), ("_BLOCK", 300), ("_WINDOW", 3), ("_MOST_BLOCKS", 60)),
            *(("_MOST_SORTED", 100), ("_SLAB", 32)),
        ):
            patch.setattr(shuffling, name, value)
        yield


@settings(database=None, deadline=None)
@given(
    name=st.sampled_from(["stored", "exact", "blocks"]), count=COUNTS, key=KEYS,
    nbytes=st.sampled_from([0, 1, 48, 5000]), data=st.data(),
)  # fmt: skip
def test_any_part_of_an_order_is_that_of_the_whole(name, count, key, nbytes, data):
    order = make_order(name, count, nbytes, key)
    whole = order.items(0, count)
    assert_array_equal(np.sort(whole), np.arange(count))
    fresh = make_order(name, count, nbytes, key)
    for _ in range(3):
        start = data.draw(st.integers(0, count))
        stop = data.draw(st.integers(start, count))
        assert_array_equal(fresh.items(start, stop), whole[start:stop])
        chunk = fresh.chunk(min(start, count - 1))
        assert chunk.start <= min(start, count - 1) < chunk.stop
        drawn = chunk.items if chunk.places is None else chunk.items[chunk.places]
        assert_array_equal(drawn, whole[chunk.start : chunk.stop])


@settings(database=None, deadline=None)
@given(count=COUNTS, key=KEYS)
def test_a_lazy_permutation_has_every_number_once(count, key):
    assert_array_equal(np.sort(scatter(np.arange(count), count, key)), np.arange(count))


@pytest.mark.slow
@pytest.mark.parametrize("draw", [permutation, lambda n, key: scatter(np.arange(n), n, key)])
def test_all_orders_are_equally_likely(draw):
    count, draws = 4, 6000
    found = Counter(tuple(draw(count, key_of(7, key)).tolist()) for key in range(draws))
    expected = draws / math.factorial(count)
    deviations = [found[each] - expected for each in itertools.permutations(range(count))]
    assert sum(each**2 for each in deviations) / expected < 50  # 23 on average, 1 in 1000


def test_orders_never_change():
    """They are part of what a seed and a checkpoint mean: these numbers must stay."""
    assert key_of(0) == KEY_OF_0
    assert permutation(10, key_of(1, 2)).tolist() == PERMUTATION
    assert scatter(np.arange(10), 10, key_of(1, 2)).tolist() == SCATTERED
    assert make_order("blocks", 40, 48, key_of(3)).items(0, 12).tolist() == BLOCKS


def test_keys_depend_on_all_bits_and_on_how_numbers_are_grouped():
    several = [
        (0,), (0, 0), (1,), (2**64,), (2**64 + 1,), (2**200,), ([],), ([0],), ([0, 1],), (0, 1),
        (1, 0), ([1, 0],),
    ]  # fmt: skip
    assert len({key_of(*each) for each in several}) == len(several)
