import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from physx_core.statistics import Normalization, RunningStatistics


def statistics_of(*blocks):
    statistics = RunningStatistics()
    for block in blocks:
        statistics.update(block)
    return statistics


def test_blocks_give_what_all_rows_give():
    rows = np.random.default_rng(0).normal(3.0, [1.0, 10.0, 0.1], size=(1000, 3))
    statistics = statistics_of(*np.array_split(rows, 7))
    assert statistics.count == 1000
    assert_allclose(statistics.mean, rows.mean(axis=0), rtol=1e-12)
    assert_allclose(statistics.std, rows.std(axis=0), rtol=1e-12)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
def test_mean_and_std_have_the_fields_shape(shape, dtype):
    rows = np.random.default_rng(0).normal(size=(50, *shape)).astype(dtype)
    statistics = statistics_of(rows[:20], rows[20:])
    assert statistics.mean.shape == statistics.std.shape == shape
    assert statistics.mean.dtype == statistics.std.dtype == np.float64
    assert_allclose(statistics.mean, rows.astype(np.float64).mean(axis=0), rtol=1e-12)


@pytest.mark.parametrize("offset", [1e6, 1e9, -1e12])
def test_a_large_offset_costs_no_digits(offset):
    exact = np.random.default_rng(0).integers(-8, 8, size=(5000, 2)) * 0.25
    statistics = statistics_of(*np.array_split(exact + offset, 13))
    assert_allclose(statistics.std, exact.std(axis=0), rtol=1e-9)
    assert_allclose(statistics.mean - offset, exact.mean(axis=0), atol=4e-16 * abs(offset))


def test_a_constant_component_is_only_shifted():
    rows = np.random.default_rng(0).normal(size=(1000, 2))
    rows[:, 0] = 1e9 + 0.1
    statistics = statistics_of(*np.array_split(rows, 9))
    normalization = statistics.normalization()
    assert statistics.std[0] == 0 and normalization.std[0] == 1
    assert normalization.mean[0] == 1e9 + 0.1
    assert normalization.std[1] == statistics.std[1]


def test_rounding_errors_count_as_constant():
    rows = np.array([[1e9], [np.nextafter(1e9, 2e9)]] * 50)
    assert statistics_of(rows).normalization().std == 1


@settings(max_examples=50, deadline=None)
@given(
    first=st.lists(st.floats(-1e6, 1e6), max_size=20),
    second=st.lists(st.floats(-1e6, 1e6), max_size=20),
)
def test_merged_is_the_same_as_given_together(first, second):
    merged = statistics_of(np.array(first))
    merged.merge(statistics_of(np.array(second)))
    together = np.array(first + second)
    assert merged.count == len(together)
    if len(together):
        assert_allclose(merged.mean, together.mean(), rtol=1e-9, atol=1e-6)
        assert_allclose(merged.std, together.std(), rtol=1e-6, atol=1e-6)


def test_plain_data_bring_it_back_and_it_goes_on():
    rows = np.random.default_rng(0).normal(1e5, 1.0, size=(300, 2))
    rows[:, 1] = 7.0
    plain = json.loads(json.dumps(statistics_of(rows[:100]).to_dict()))
    statistics = RunningStatistics.from_dict(plain)
    statistics.update(rows[100:])
    assert statistics.count == 300
    assert_allclose(statistics.mean, rows.mean(axis=0), rtol=1e-14)
    assert_allclose(statistics.std, rows.std(axis=0), rtol=1e-9)
    assert statistics.std[1] == 0


def test_nothing_given():
    statistics = statistics_of(np.empty((0, 3)))
    assert statistics.count == 0
    statistics.merge(RunningStatistics())
    assert statistics.count == 0


def test_normalization_as_plain_data():
    normalization = Normalization(np.array([1.0, 2.0]), np.array([0.1, 1 / 3]))
    back = Normalization.from_dict(json.loads(json.dumps(normalization.to_dict())))
    assert np.array_equal(back.mean, normalization.mean)
    assert np.array_equal(back.std, normalization.std)
