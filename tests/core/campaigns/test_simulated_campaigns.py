"""Campaigns in simulated clients: whatever happens to these, a number has its rows or has failed.

All is in one thread and in simulated time; what is compared with is the simplest model.
"""

from __future__ import annotations

import pytest
import sizes
from campaigns import FAILS, TROUBLED, Results, leased, rows_of
from fated import Fate, Fates
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from simulated import Simulation, drawn

from physx_core import EnvironmentConfig
from physx_core.errors import PhysxError
from physx_core.workers.episode_queue import EpisodeQueue

pytestmark = pytest.mark.slow

SEED = [5, 2]
SIMULATED = {"phases": [Phase.explicit, Phase.generate]}


def simulate(simulation, total, count, *, fates=None, recorded=(), env_kwargs=None, **options):
    """Return what simulated clients have made of the numbers of a campaign."""
    simulation.fates, simulation.ready = Fates(fates or {}, count), []
    options = {"launcher": "fated:FatedLauncher", "timeout": 30.0, **options}
    kwargs = env_kwargs or {}
    config = EnvironmentConfig(TROUBLED, num_clients=count, env_kwargs=kwargs, **options)
    queue = EpisodeQueue(total, recorded)
    with leased(config, SEED, queue, transport=simulation) as source:
        idle = [fate for each in (fates or {}).values() for fate in each if fate.state == "idle"]
        return Taking(simulation, idle).take_all(source, queue)


class Taking(Results):
    """What clients have simulated, some of which meet their fates between two blocks."""

    def __init__(self, simulation, idle):
        super().__init__()
        self.simulation, self.blocks, self.idle = simulation, 0, idle

    def add(self, block):
        super().add(block)
        self.blocks += 1
        if self.idle:
            ready = [c for c in self.simulation.alive.values() if c in self.simulation.ready]
            for client in ready:
                self.simulation.fates.strike(client, "idle", self.blocks)


def check(results, total, recorded=(), troubles=None, lost=(), **options):
    """Check each missing number: only those in `lost` may have failed without a trouble."""
    missing = [number for number in range(total) if number not in recorded]
    assert sorted([*results.rows, *results.failed]) == missing
    for number in missing:
        expected = rows_of(number, SEED, troubles, **options)
        if number in results.rows:
            assert results.rows[number] == expected
        else:
            assert expected is None or number in lost


TROUBLES = st.dictionaries(
    st.integers(0, 15).map(str),
    st.tuples(st.sampled_from(FAILS), st.integers(0, 3)).map(list),
    max_size=4,
)


@settings(max_examples=sizes.size(60, 10), **SIMULATED)
@given(drawn, st.integers(0, 15), st.integers(1, 3), st.sets(st.integers(0, 20), max_size=6))
def test_clients_make_the_rows_of_each_number(choose, total, count, recorded):
    with Simulation(choose) as simulation:
        results = simulate(simulation, total, count, recorded=recorded)
    check(results, total, recorded)


@settings(max_examples=sizes.size(60, 10), **SIMULATED)
@given(drawn, st.integers(1, 15), st.integers(1, 3), TROUBLES, st.sampled_from([0.0, 0.01, 0.2]))
def test_episodes_fail_alone(choose, total, count, troubles, pace):
    with Simulation(choose) as simulation:
        kwargs = {"troubles": troubles, "pace": pace}
        results = simulate(simulation, total, count, env_kwargs=kwargs)
    check(results, total, troubles=troubles)


@settings(max_examples=sizes.size(30, 6), **SIMULATED)
@given(drawn, st.integers(1, 15), st.integers(1, 3), TROUBLES)
def test_episodes_with_parameters_fail_alone(choose, total, count, troubles):
    with Simulation(choose) as simulation:
        kwargs = {"troubles": troubles, "parameters": True}
        options = {"env_kwargs": kwargs, "sampler": "physx/sobol"}
        results = simulate(simulation, total, count, **options)
    check(results, total, troubles=troubles)
    heights = [each["height"] for each in results.parameters.values()]
    assert len(set(heights)) == len(heights)


@settings(max_examples=sizes.size(20, 5), **SIMULATED)
@given(drawn, st.integers(1, 60), st.integers(1, 3), TROUBLES)
def test_single_rows_that_are_joined_fail_alone(choose, total, count, troubles):
    troubles = {number: [kind, 0] for number, (kind, _) in troubles.items()}
    with Simulation(choose) as simulation:
        kwargs = {"troubles": troubles, "least": 1}
        results = simulate(simulation, total, count, env_kwargs=kwargs, episode_steps=1)
    check(results, total, troubles=troubles, least=1, episode_steps=1)


# Lost clients ------------------------------------------------------------------------------------


EVENTS = ["exits", "is killed", "hangs", "vanishes"]
FATES = st.lists(
    st.builds(Fate, st.sampled_from(["busy", "idle"]), st.sampled_from(EVENTS), st.integers(0, 9)),
    max_size=2,
)


@settings(max_examples=sizes.size(100, 10), **SIMULATED)
@given(drawn, st.integers(1, 12), st.tuples(FATES, FATES, FATES), st.integers(1, 3),
       st.sampled_from([0.0, 0.01, 0.2]))  # fmt: skip
def test_rows_do_not_depend_on_who_is_lost(choose, total, fates, count, pace):
    given = {number: each for number, each in enumerate(fates, 1) if number <= count}
    with Simulation(choose) as simulation:
        try:
            kwargs = {"pace": pace, "once": True}
            results = simulate(simulation, total, count, fates=given, env_kwargs=kwargs)
        except PhysxError as error:
            # More idle clients were lost than there are: something else is wrong with them.
            idle = [f for each in given.values() for f in each if f.began is not None]
            assert len(idle) > count, error
            return
    met = [fate for each in given.values() for fate in each if fate.began is not None]
    check(results, total, lost=range(total))
    assert results.fields == {number: {"number": number} for number in results.rows}
    assert len(results.failed) <= len(met) // 2  # each was lost twice


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("state", ["busy", "idle"])
@pytest.mark.parametrize("after", [0, 1, 5])
def test_one_lost_client_costs_no_episode(state, event, after):
    with Simulation() as simulation:
        fates = {1: [Fate(state, event, after)]}
        results = simulate(simulation, 9, 2, fates=fates, env_kwargs={"pace": 0.05, "least": 2})
    check(results, 9, least=2)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("pace", [0.0, 0.05])
def test_number_that_ends_its_clients_fails_and_no_other(count, pace):
    troubles = {"13": ["ends the process", 1]}
    with Simulation() as simulation:
        kwargs = {"troubles": troubles, "pace": pace, "least": 2}
        results = simulate(simulation, 40, count, env_kwargs=kwargs)
    assert list(results.failed) == [13]
    assert "exit status 3" in results.failed[13]
    check(results, 40, lost=[13], least=2)


@pytest.mark.parametrize("event", EVENTS)
def test_client_that_is_lost_between_parts_of_an_episode(event):
    size = {"width": 40_000, "most": 4}
    troubles = {"1": ["is long", 9]}
    with Simulation() as simulation:
        fates = {1: [Fate("busy", event, 7)]}
        kwargs = {"troubles": troubles, "pace": 0.05, **size}
        results = simulate(simulation, 3, 1, fates=fates, env_kwargs=kwargs)
    check(results, 3, troubles=troubles, **size)
    begun = [record.part for record in results.records if record.episode == 1]
    assert begun.count(0) == 1 + (len(begun) > max(begun) + 1)


def test_last_number_after_one_that_is_not_finite_is_simulated():
    troubles = {"2": ["is not finite", 0]}
    with Simulation() as simulation:
        results = simulate(simulation, 12, 1, env_kwargs={"troubles": troubles, "least": 1})
    check(results, 12, troubles=troubles, least=1)
    assert simulation.monotonic() < 1010  # nobody waited for it to be called silent


def test_numbers_after_one_that_is_not_finite_keep_their_parameters():
    troubles = {"6": ["is not finite", 0]}
    with Simulation() as simulation:
        kwargs = {"troubles": troubles, "least": 1, "parameters": True}
        results = simulate(simulation, 40, 1, env_kwargs=kwargs, sampler="physx/sobol")
    check(results, 40, troubles=troubles, least=1)


@settings(max_examples=sizes.size(20, 4), **SIMULATED)
@given(drawn, st.integers(1, 3), st.tuples(FATES, FATES, FATES), st.integers(4, 20))
def test_episodes_of_several_parts_do_not_depend_on_who_is_lost(choose, count, fates, long):
    size = {"width": 40_000, "most": 4}
    troubles = {"1": ["is long", long], "3": ["is long", 7]}
    given = {n: [f for f in each if f.state == "busy"] for n, each in enumerate(fates, 1)}
    given = {number: each for number, each in given.items() if number <= count}
    with Simulation(choose) as simulation:
        kwargs = {"troubles": troubles, "pace": 0.05, **size}
        results = simulate(simulation, 6, count, fates=given, env_kwargs=kwargs)
    met = [fate for each in given.values() for fate in each if fate.began is not None]
    check(results, 6, troubles=troubles, lost=range(6), **size)
    assert len(results.failed) <= len(met) // 2


def test_long_episode_is_sent_in_parts_every_ten_seconds():
    with Simulation() as simulation:
        kwargs = {"pace": 3.0, "troubles": {"1": ["is long", 20]}}
        results = simulate(simulation, 3, 2, env_kwargs=kwargs, timeout=300.0)
    check(results, 3, troubles={"1": ["is long", 20]})
    parts = [record.rows for record in results.records if record.episode == 1]
    assert parts == [4, 4, 4, 4, 4, 0]
