"""Episodes of a campaign in this process, against the simplest model: rows by number."""

from __future__ import annotations

import itertools

import pytest
import sizes
from campaigns import FAILS, TROUBLED, UNCHECKED, Results, leased, rows_of
from hypothesis import given, settings
from hypothesis import strategies as st

from physx_core import EnvironmentConfig
from physx_core.dataset import EpisodeStatus
from physx_core.errors import MissingFieldError, UsageError
from physx_core.sources import LocalSource
from physx_core.workers.episode_queue import EpisodeQueue

SEED = [5, 2]


def simulate(total, env_kwargs, recorded=(), environment=TROUBLED, **options):
    """Return what a source in this process has simulated."""
    queue = EpisodeQueue(total, recorded)
    config = EnvironmentConfig(
        environment, as_tcp_ip_client=False, env_kwargs=env_kwargs, **options
    )
    with leased(config, SEED, queue) as source:
        return Results().take_all(source, queue)


def check(results, total, recorded=(), troubles=None, **options):
    """Check that each missing number has ended, with exactly its rows."""
    missing = [number for number in range(total) if number not in recorded]
    expected = {number: rows_of(number, SEED, troubles, **options) for number in missing}
    failed = {number for number, rows in expected.items() if rows is None}
    assert results.failed.keys() == failed
    assert results.rows == {n: rows for n, rows in expected.items() if rows is not None}


TROUBLES = st.dictionaries(
    st.integers(0, 15).map(str),
    st.tuples(st.sampled_from(FAILS), st.integers(0, 3)).map(list),
    max_size=6,
)


@pytest.mark.slow
@given(st.integers(0, 15), st.sets(st.integers(0, 20), max_size=8), TROUBLES, st.booleans())
@settings(max_examples=sizes.size(80, 15))
def test_each_number_has_its_rows_or_has_failed(total, recorded, troubles, has_parameters):
    kwargs = {"troubles": troubles, "parameters": has_parameters}
    results = simulate(total, kwargs, recorded, sampler="physx/sobol" if has_parameters else None)
    check(results, total, recorded, troubles)
    assert all((set(each) == {"height"}) == has_parameters for each in results.parameters.values())


@pytest.mark.slow
@given(TROUBLES, st.integers(0, 3))
@settings(max_examples=sizes.size(40, 10))
def test_blocks_of_few_rows_hold_parts(troubles, long):
    troubles = {**troubles, "4": ["is long", 5 + long], "7": ["is long", 0]}
    size = {"width": 40_000, "most": 4}  # three rows are a block
    results = simulate(10, {"troubles": troubles, **size})
    check(results, 10, troubles=troubles, **size)
    assert max(record.part for record in results.records) >= 1


@pytest.mark.slow
def test_episode_of_more_rows_than_a_block_has_parts():
    troubles = {"1": ["is long", 9000]}
    results = simulate(3, {"troubles": troubles})
    check(results, 3, troubles=troubles)
    parts = [(each.part, each.status) for each in results.records if each.episode == 1]
    assert [part for part, _ in parts] == list(range(len(parts)))
    assert len(parts) >= 3
    assert {status for _, status in parts[:-1]} == {EpisodeStatus.MORE}


@pytest.mark.slow
@pytest.mark.parametrize("at", [0, 5000, 8999])
def test_failed_episode_leaves_no_rows_of_its_parts(at):
    for kind in ("raises", "is not finite"):
        queue = EpisodeQueue(4)
        kwargs = {"troubles": {"1": [kind, at]}, "least": 9000, "most": 9000, "width": 1}
        config = EnvironmentConfig(TROUBLED, as_tcp_ip_client=False, env_kwargs=kwargs)
        with leased(config, SEED, queue) as source:
            results = Results().take_all(source, queue)
        assert list(results.failed) == [1]
        assert sorted(results.rows) == [0, 2, 3]
        assert {len(rows) for rows in results.rows.values()} == {9000}


# Episodes of one row -----------------------------------------------------------------------------


@given(
    st.sets(st.integers(0, 120), max_size=8),
    TROUBLES,
    st.sampled_from([TROUBLED, UNCHECKED]),
    st.integers(0, 1),
)
@settings(max_examples=sizes.size(80, 20))
def test_records_of_one_row_are_joined(recorded, troubles, environment, least):
    troubles = {number: [kind, 0] for number, (kind, _) in troubles.items()}
    if environment == UNCHECKED:  # these happen in check_sample()
        unknown = "raises late", "is rejected"
        troubles = {n: trouble for n, trouble in troubles.items() if trouble[0] not in unknown}
    single = {"least": least, "most": 3}
    kwargs = {"troubles": troubles, **single}
    results = simulate(100, kwargs, recorded, environment, episode_steps=1)
    check(results, 100, recorded, troubles, episode_steps=1, **single)
    assert all(record.rows in (0, record.count) for record in results.records)


@pytest.mark.parametrize("environment", [TROUBLED, UNCHECKED])
@pytest.mark.parametrize("kind", ["asks for the wrong", "lacks a field"])
def test_mistake_in_one_row_ends_the_campaign(environment, kind):
    with pytest.raises((UsageError, MissingFieldError)):
        simulate(50, {"least": 1, "troubles": {"30": [kind, 0]}}, (), environment, episode_steps=1)


@pytest.mark.slow
@pytest.mark.parametrize("environment", [TROUBLED, UNCHECKED])
def test_joined_records_hold_the_parameters_of_each(environment):
    results = simulate(20, {"least": 1, "parameters": True}, (), environment, episode_steps=1,
                       sampler="physx/sobol")  # fmt: skip
    assert len(results.records) < 10
    heights = [results.parameters[number]["height"] for number in range(20)]
    assert len(set(heights)) == 20
    parts = [simulate(20, {"least": 1, "parameters": True}, recorded, episode_steps=1,
                      sampler="physx/sobol").parameters
             for recorded in (range(10), range(10, 20))]  # fmt: skip
    assert [parts[number < 10][number]["height"] for number in range(20)] == heights


@pytest.mark.slow
def test_thousands_of_numbers_are_few_records():
    results = simulate(5000, {"least": 1}, episode_steps=1)
    check(results, 5000, least=1, episode_steps=1)
    assert len(results.records) < 500
    firsts = sorted((record.episode, record.count) for record in results.records)
    assert all(a + count == b for (a, count), (b, _) in itertools.pairwise(firsts))


# Episodes without rows, and mistakes -------------------------------------------------------------


def test_campaign_of_episodes_without_rows_ends():
    results = simulate(2000, {"most": 0})
    assert results.rows == {number: [] for number in range(2000)}


def test_all_episodes_may_fail():
    troubles = {str(number): [FAILS[number % len(FAILS)], 0] for number in range(30)}
    results = simulate(30, {"troubles": troubles, "least": 1})
    assert sorted(results.failed) == list(range(30))
    assert all(results.failed.values())


def test_reasons_name_what_happened():
    troubles = {"1": ["raises", 1], "2": ["raises early", 0], "3": ["raises late", 1],
                "4": ["is rejected", 0], "5": ["is not finite", 1]}  # fmt: skip
    results = simulate(6, {"troubles": troubles, "least": 2})
    assert "no more beans for 1" in results.failed[1]
    assert "no beans for 2" in results.failed[2]
    assert "late beans for 3" in results.failed[3]
    assert "check_sample" in results.failed[4]
    assert '"x"' in results.failed[5]


@pytest.mark.parametrize(
    ("mistake", "error", "said"),
    [
        ("asks for the wrong", UsageError, r"new_episode\(\)"),
        ("lacks a field", MissingFieldError, '"n" is missing'),
    ],
)
def test_mistake_of_all_episodes_ends_the_campaign(mistake, error, said):
    queue = EpisodeQueue(5)
    kwargs = {"troubles": {"2": [mistake, 0]}, "least": 1}
    config = EnvironmentConfig(TROUBLED, as_tcp_ip_client=False, env_kwargs=kwargs)
    with (
        leased(config, SEED, queue) as source,
        pytest.raises(error, match=said),
    ):
        Results().take_all(source, queue)


def test_stream_has_no_episodes_to_count():
    with (
        LocalSource(EnvironmentConfig("toy/spring"), None, SEED) as source,
        pytest.raises(UsageError, match="is a stream, which has no episodes to count"),
    ):
        source.check_independent()
