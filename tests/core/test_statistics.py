import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from sizes import size

from physx_core import Dataset, Field, Normalization
from physx_core.array_file import pack, unpack
from physx_core.normalization import compute_normalization
from physx_core.statistics import RunningStatistics


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


def test_statistics_that_are_written_as_they_were_read_do_not_change():
    for seed in range(50):
        rows = np.random.default_rng(seed).normal(size=(20, 4))
        arrays = statistics_of(rows).arrays()
        again = RunningStatistics.from_arrays(arrays, (4,)).arrays()
        assert {name: a.tolist() for name, a in again.items()} == {
            name: a.tolist() for name, a in arrays.items()
        }


def normalization_of(statistics):
    field = Field("x", statistics.mean.shape)
    return compute_normalization(True, {"x": field}, {"x": field}, lambda of: statistics)["x"]


def through_arrays(statistics):
    """Statistics as they are after they have been in a file."""
    if not statistics.count:
        return statistics
    return RunningStatistics.from_arrays(statistics.arrays(), statistics.mean.shape)


def test_merged_statistics_do_not_depend_on_which_of_them_were_stored_before():
    rows = np.random.default_rng(0).normal(1e3, 2.0, size=(90, 4))
    parts = [statistics_of(block) for block in np.array_split(rows, 5)]
    plain, stored = RunningStatistics(), RunningStatistics()
    for number, part in enumerate(parts):
        plain.merge(part)
        stored = through_arrays(stored) if number % 2 else stored
        stored.merge(through_arrays(part) if number % 3 else part)
    for name, array in plain.arrays().items():
        assert (array == stored.arrays()[name]).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mean", np.array([0.0, np.nan])),
        ("mean", np.array([0.0, np.inf])),
        ("mean", np.zeros(3)),
        ("mean", np.zeros(2, "float32")),
        ("squares", np.array([-1.0, 0.0])),
        ("squares", np.array([np.nan, 0.0])),
        ("squares", np.zeros((2, 1))),
        ("minimum", np.array([np.inf, 0.0])),
        ("count", np.array(0, np.int64)),
        ("count", np.array(-4, np.int64)),
        ("count", np.array([4, 4], np.int64)),
        ("count", np.array(4.0)),
        ("count", None),
        ("other", np.zeros(2)),
    ],
)
def test_arrays_that_are_no_statistics_are_refused(name, value):
    arrays = statistics_of(np.ones((4, 2))).arrays()
    arrays[name] = value
    if value is None:
        del arrays[name]
    with pytest.raises(ValueError, match="invalid|not statistics"):
        RunningStatistics.from_arrays(arrays, (2,))


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
    normalization = normalization_of(statistics)
    assert statistics.std[0] == 0 and normalization.std[0] == 1
    assert normalization.mean[0] == 1e9 + 0.1
    assert normalization.std[1] == statistics.std[1]


def test_rounding_errors_count_as_constant():
    rows = np.array([[1e9], [np.nextafter(1e9, 2e9)]] * 50)
    assert normalization_of(statistics_of(rows)).std == 1


@settings(max_examples=size(50, 6))
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


@given(
    st.sampled_from([(), (3,), (0, 2), (600,)]),
    st.lists(st.tuples(st.sampled_from(["update", "merge", "plain"]), st.integers(0, 9))),
    st.sampled_from([0.0, 1e6]),
)
@pytest.mark.reported(
    "lerobot#3682",
    "openpi#688",
    "lerobot#699",
    about="stored deviations are wrong, or of other data",
)
def test_any_history_gives_what_all_rows_give(shape, history, offset):
    random, statistics, blocks = np.random.default_rng(0), RunningStatistics(), []
    for call, count in history:
        block = random.integers(-99, 99, (count, *shape)) + offset
        if call == "plain":
            statistics = through_arrays(statistics)
            continue
        blocks.append(block)
        if call == "update":
            statistics.update(block)
        else:
            other = statistics_of(block[: count // 2], block[count // 2 :])
            statistics.merge(other)
            assert other.count == count
    rows = np.concatenate([np.zeros((0, *shape)), *blocks])
    assert statistics.count == len(rows)
    if len(rows):
        assert_allclose(statistics.mean, rows.mean(axis=0), rtol=1e-12, atol=1e-9)
        assert_allclose(statistics.std, rows.std(axis=0), rtol=1e-9, atol=1e-9)
        assert (statistics.minimum == rows.min(axis=0)).all()
        assert (statistics.maximum == rows.max(axis=0)).all()
        assert statistics.mean.shape == shape


HUGE = np.finfo(np.float64).max


@settings(max_examples=size(200, 25))
@given(st.lists(st.lists(st.floats(-HUGE, HUGE), min_size=1, max_size=5), min_size=1, max_size=5))
@example([[HUGE, -HUGE], [HUGE]])
@example([[1e200], [-1e200, 0.0]])
@example([[0.0], [1e154, 1e155]])
def test_numbers_of_any_size_have_finite_statistics(blocks):
    statistics, merged = RunningStatistics(), RunningStatistics()
    for block in map(np.array, blocks):
        statistics.update(block)
        merged = through_arrays(merged)
        merged.merge(statistics_of(block))
    rows = np.concatenate(blocks)
    least, most = float(rows.min()), float(rows.max())
    rounding = 1e-15 * max(-least, most) + 1e-150  # squares of less have few digits
    for found in (statistics, merged):
        assert (found.minimum, found.maximum) == (least, most)
        assert 0 <= found.std / 2 <= most / 4 - least / 4 + rounding
        assert least - rounding <= found.mean <= most + rounding


def test_a_dataset_of_huge_numbers_is_opened_again(tmp_path):
    with Dataset.create(tmp_path / "data") as dataset:
        dataset.append("training", {"x": np.array([1e200, -1e200, 1e300])})
    with Dataset.open(tmp_path / "data") as dataset:
        assert dataset.verify() == []
        assert np.isfinite(dataset.normalization["x"].std)


def test_arrays_bring_it_back_and_it_goes_on():
    rows = np.random.default_rng(0).normal(1e5, 1.0, size=(300, 2))
    rows[:, 1] = 7.0
    statistics = through_arrays(statistics_of(rows[:100]))
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
    back = Normalization.from_arrays(normalization.arrays(), (2,))
    assert np.array_equal(back.mean, normalization.mean)
    assert np.array_equal(back.std, normalization.std)


# Minimum and maximum ----------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 3), (700,), (0,)])
@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
@pytest.mark.parametrize("parts", [1, 7])
def test_minimum_and_maximum_are_exact(shape, dtype, parts):
    rows = np.random.default_rng(1).normal(size=(1000, *shape)).astype(dtype)
    statistics = statistics_of(*np.array_split(rows, parts))
    assert (statistics.minimum == rows.min(axis=0)).all()
    assert (statistics.maximum == rows.max(axis=0)).all()
    assert statistics.minimum.dtype == statistics.maximum.dtype == np.float64
    assert statistics.minimum.shape == statistics.maximum.shape == shape


@pytest.mark.parametrize("first", [0, 1, 400, 1000])
def test_merged_extremes_are_those_of_all_rows(first):
    rows = np.random.default_rng(2).normal(size=(1000, 4))
    merged = statistics_of(rows[:first])
    merged.merge(statistics_of(rows[first:]))
    merged.merge(RunningStatistics())
    assert (merged.minimum == rows.min(axis=0)).all()
    assert (merged.maximum == rows.max(axis=0)).all()


def test_extremes_survive_the_way_through_a_file():
    statistics = statistics_of(np.random.default_rng(3).normal(size=(10, 2)))
    again = through_arrays(statistics)
    again.update(np.array([[100.0, 0.0]]))
    assert (again.minimum == statistics.minimum).all()
    assert again.maximum.tolist() == [100, statistics.maximum[1]]
    normalization = normalization_of(again)
    back = Normalization.from_arrays(unpack(pack(normalization.arrays())), (2,))
    for name in ("mean", "std", "minimum", "maximum"):
        assert (getattr(back, name) == getattr(normalization, name)).all()


def test_a_normalization_without_extremes_is_kept_without_them():
    given = {"mean": np.array([1.0, 2.0]), "std": np.array([0.1, 0.2])}
    normalization = Normalization.from_arrays(given, (2,))
    assert normalization.minimum is None and normalization.arrays().keys() == given.keys()
    for arrays in ({"mean": given["mean"]}, {**given, "other": given["mean"]}):
        with pytest.raises(ValueError, match="not those of a normalization"):
            Normalization.from_arrays(arrays, (2,))
