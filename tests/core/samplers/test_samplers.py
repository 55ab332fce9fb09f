"""A sampler's choice depends on the seed and the number of the set alone, and fills the space."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physx_core import Parameter
from physx_core.errors import ConfigError, MissingLibraryError
from physx_core.plugins import resolve
from physx_core.random_streams import first_numbers

PARAMETERS = [
    Parameter("k", 10.0, 40.0),
    Parameter("push", [-1.0, 0.0], [1.0, 2.0], shape=(2,)),
    Parameter("n", 1, 4, distribution="integer"),
]


def begun(name, parameters=PARAMETERS, seed=(3, 0, 0), **options):
    sampler = resolve("sampler", f"physx/{name}")(**options)
    sampler.begin(parameters, seed)
    return sampler


def table(folder):
    rows = [[10 + i, i / 10, i / 5, 1 + i % 4] for i in range(7)]
    lines = ["n,k,other,push_1,push_0", *(f"{n},{k},x,{b},{a}" for k, a, b, n in rows)]
    (folder / "sets.csv").write_text("\n".join(lines))
    columns = list(zip(*rows, strict=True))
    np.savez(
        folder / "sets.npz", k=columns[0], push=np.transpose(columns[1:3]), n=np.array(columns[3])
    )
    return rows


@pytest.fixture(params=["uniform", "sobol", "latin_hypercube", "grid", "csv", "npz"])
def make(request, tmp_path):
    """Return a function that makes one of the samplers for a seed."""
    if request.param in ("csv", "npz"):
        table(tmp_path)
        return lambda seed=(3, 0, 0): begun(
            "table", seed=seed, file=f"{tmp_path}/sets.{request.param}"
        )
    return lambda seed=(3, 0, 0): begun(request.param, seed=seed)


def flat(values):
    return (values["k"], *values["push"], values["n"])


def test_a_set_is_the_same_whatever_was_asked_for_before(make):
    numbers = [0, 1, 5, 99, 100, 3, 2047, 2048, 1023, 1024, 10**6, 0]
    first = make()
    chosen = {number: flat(first.ask(number)) for number in numbers}
    for number in reversed(numbers):
        assert flat(make().ask(number)) == chosen[number]


def test_several_sets_are_those_asked_for_one_by_one(make):
    for first, count in [(0, 1), (5, 3), (1020, 10), (2046, 3000), (99, 102), (3, 4)]:
        sets = [make().ask(number) for number in (first, first + count - 1)]
        several = make().ask_many(first, count)
        for place, one in zip((0, -1), sets, strict=True):
            assert flat({name: values[place] for name, values in several.items()}) == flat(one)
        one_by_one, sampler = [], make()
        for number in range(first, first + min(count, 20)):
            one_by_one.append(flat(sampler.ask(number)))
        columns = {name: values[: len(one_by_one)] for name, values in several.items()}
        assert [
            flat({name: values[place] for name, values in columns.items()})
            for place in range(len(one_by_one))
        ] == one_by_one


@given(
    st.sampled_from(["uniform", "log_uniform", "normal", "truncated", "integer"]),
    st.integers(0, 10**12),
    st.integers(1, 40),
    st.lists(st.integers(0, 2**70), min_size=1, max_size=6),
)
def test_several_sets_have_the_bits_of_single_ones(distribution, first, count, seed):
    options = {"low": 1, "high": 30} if distribution != "normal" else {}
    if distribution in ("normal", "truncated"):
        options |= {"distribution": "normal", "mean": [3.0, 4.0], "deviation": 2.0}
    else:
        options |= {"distribution": distribution}
    sampler = begun("uniform", [Parameter("a", shape=(2,), **options)], seed)
    singles = [sampler.ask(number)["a"] for number in range(first, first + count)]
    several = sampler.ask_many(first, count)["a"]
    assert several.dtype == singles[0].dtype
    assert several.tobytes() == np.array(singles).tobytes()


@given(
    st.one_of(
        st.integers(0, 2**200),
        st.lists(st.integers(0, 2**70), min_size=1, max_size=6),
    ),
    st.sampled_from([0, 1, 2**31, 2**32 - 3, 2**32, 2**40]),
    st.integers(0, 2**32 - 1),
    st.integers(0, 5),
)
def test_first_numbers_are_those_of_new_generators(entropy, first, stream, size):
    numbers = range(first, first + 5)
    keys = [np.random.SeedSequence(entropy, spawn_key=(number, stream)) for number in numbers]
    expected = [np.random.default_rng(key).random(size) for key in keys]
    found = first_numbers(entropy, numbers, stream, size)
    assert found.tobytes() == np.array(expected).tobytes()


def test_values_lie_within_the_bounds_and_have_their_types(make):
    sampler = make()
    for number in range(200):
        values = sampler.ask(number)
        assert all(parameter.contains(values[parameter.name]) for parameter in PARAMETERS)
        assert np.shape(values["push"]) == (2,)
        assert int(values["n"]) == values["n"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["uniform", "sobol", "latin_hypercube"])
def test_other_seeds_and_numbers_have_other_values(name):
    sets = {flat(begun(name, seed=seed).ask(n)) for seed in ([1], [2], [1, 5]) for n in range(40)}
    assert len(sets) == 120


@pytest.mark.slow
def test_a_sobol_sequence_fills_every_part_once():
    sampler = begun("sobol", [Parameter("a", 0, 1), Parameter("b", 0, 1)])
    points = np.array([list(sampler.ask(n).values()) for n in range(64)])
    cells = np.floor(points * 8).astype(int)
    assert len({*map(tuple, cells.tolist())}) == 64


@pytest.mark.slow
def test_each_latin_hypercube_has_one_set_in_each_part_of_each_parameter():
    sampler = begun("latin_hypercube", points=10)
    for first in (0, 10, 70):
        k = [sampler.ask(first + n)["k"] for n in range(10)]
        assert sorted(np.floor((np.array(k) - 10) / 3)) == list(range(10))


def test_a_grid_has_all_combinations_bounds_included_and_starts_over():
    grid = begun("grid", points={"k": 3, "push": 2, "n": 4})
    expected = itertools.product([10, 25, 40], [-1, 1], [0, 2], [1, 2, 3, 4])
    assert grid.count == 48
    assert [flat(grid.ask(number)) for number in range(48)] == list(expected)
    assert flat(grid.ask(48)) == flat(grid.ask(0))


def test_a_grid_of_any_size_takes_no_memory():
    grid = begun("grid", points=10**12)
    assert grid.count == 10**48
    assert flat(grid.ask(10**48 - 1)) == flat(begun("grid", points=2).ask(15))
    assert grid.ask(10**12 // 2)["n"] in (2, 3)


def test_a_grid_has_as_many_values_of_a_distribution_without_bounds():
    normal = Parameter("a", mean=0.0, deviation=1.0, distribution="normal")
    values = [begun("grid", [normal], points=3).ask(n)["a"] for n in range(3)]
    assert values == pytest.approx([-0.967421566, 0.0, 0.967421566])


@pytest.mark.parametrize("form", ["csv", "npz"])
def test_a_table_has_its_rows_over_and_over(tmp_path, form):
    rows = table(tmp_path)
    sampler = begun("table", file=tmp_path / f"sets.{form}")
    assert sampler.count == 7
    assert [list(flat(sampler.ask(number))) for number in range(14)] == rows * 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("k,push_0,push_1\n1,2,3", 'no column "n"'),
        ("k,push_0,push_1,n", "have 0 rows"),
        ("k,push_0,push_1,n\n20,0,1,2\n41,0,1,2", "Row 2.*k = 41.0 is not within its bounds"),
        ("k,push_0,push_1,n\nnan,0,1,2", "Row 1.*not finite"),
        ("k,push_0,push_1,n\n20,0,1,2.5", "cannot be read.*2.5"),
        ("k,push_0,push_1,n\n20,0,1", "cannot be read.*3 columns"),
    ],
)
def test_a_table_that_does_not_fit_is_an_error_that_names_the_place(tmp_path, content, message):
    (tmp_path / "sets.csv").write_text(content)
    with pytest.raises(ConfigError, match=message):
        begun("table", file=tmp_path / "sets.csv")


def test_a_table_of_pickles_is_not_read(tmp_path):
    columns = {p.name: np.array([object()]) for p in PARAMETERS}
    np.savez(tmp_path / "sets.npz", **columns)
    with pytest.raises(ConfigError, match="cannot be read"):
        begun("table", file=tmp_path / "sets.npz")


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("grid", {"points": 0}, "at least 1"),
        ("grid", {"points": {"k": 2, "push": 2, "m": 2}}, '"m" is none of them'),
        ("grid", {"points": {"k": 2, "push": 2}}, '"n" is missing'),
        ("latin_hypercube", {"points": 0}, "at least 1"),
        ("table", {"file": "nowhere.csv"}, "cannot be read"),
    ],
)
def test_options_that_do_not_fit_are_errors(name, options, message):
    with pytest.raises(ConfigError, match=message):
        begun(name, **options)


@pytest.mark.parametrize("name", ["sobol", "latin_hypercube"])
def test_a_missing_library_names_the_extra_that_has_it(name, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.stats", None)
    with pytest.raises(MissingLibraryError, match=r"physx.core\[samplers\]"):
        begun(name)


def test_an_active_sampler_continues_from_its_state():
    """Told the same batches, a restored sampler chooses what the other one does."""
    random = np.random.default_rng(0)
    uniform = begun("uniform")
    sampler, options = begun("active", memory=20), {"memory": 20, "seed": (3, 0, 0)}
    batches = [np.unique(random.integers(0, 8, 5)) + 4 * n for n in range(20)]

    def tell(one, number):
        sets = batches[number]
        one.tell(sets, [uniform.ask(k) for k in sets], np.sin(sets) + 1)

    for number in range(12):
        tell(sampler, number)
    restored = begun("active", **options)
    restored.restore(sampler.state())
    for number in (12, 13):
        assert [flat(restored.ask(k)) for k in range(50, 90)] == [
            flat(sampler.ask(k)) for k in range(50, 90)
        ]
        for one in (sampler, restored):
            tell(one, number)
    with pytest.raises(ValueError, match="other"):
        begun("active", **{**options, "memory": 3}).restore(sampler.state())
    with pytest.raises(ValueError, match="other"):
        begun("active", [Parameter("a", [0] * 50, [1] * 50, shape=(50,))]).restore(sampler.state())
