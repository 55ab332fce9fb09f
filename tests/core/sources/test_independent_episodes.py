"""Independent episodes: their rows follow from the number alone, whoever simulates them."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import sizes
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from physx_core import EnvironmentConfig
from physx_core.errors import EnvironmentFailedError, UsageError, WrongSamplesError
from physx_core.sources import LocalSource

ENVS = Path(__file__).parents[1] / "programs" / "episode_envs.py"
SEED = 5


def named(name):
    return f"{ENVS}:{name}"


def open_local(services, environment, seed=(SEED,), **options):
    return LocalSource(EnvironmentConfig(named(environment), **options), services, seed)


def stream(number, seed=SEED):
    """Return NumPy's generator for an episode; -1: for what comes before the first one."""
    key = np.random.SeedSequence([seed]).generate_state(2, np.uint64)
    counter = [0, 0, 1, 0] if number < 0 else [0, 0, 0, number]
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


# Against the simplest model ----------------------------------------------------------------------


def chapter(number, ends, refuse):
    """Return the accepted rows of an episode of `Chapters`."""
    rng, offset = stream(number), stream(-1).random()
    left = int(rng.integers(ends == "with the row", 5))
    x = rng.normal()
    rows = []
    for step in range(left):
        x += rng.normal()
        if not refuse or int(1000 * abs(x)) % refuse:
            rows.append([x, offset, step])
    return rows


def rows_of_stream(place, instances, ends, refuse):
    for episode in itertools.count():
        for row in chapter(episode * instances + place, ends, refuse):
            yield episode, row


def expected(count, instances, ends, refuse):
    """Return the first rows: row r is the next one of stream r % instances."""
    streams = [rows_of_stream(place, instances, ends, refuse) for place in range(instances)]
    return [next(streams[row % instances]) for row in range(count)]


CHAPTERS = {
    "instances": st.integers(1, 3),
    "ends": st.sampled_from(["with the row", "before the row"]),
    "refuse": st.sampled_from([0, 2, 3]),
    "batches": st.lists(st.integers(1, 9), min_size=1, max_size=4),
}


def check_chapters(make, instances, ends, refuse, batches):
    kwargs = {"ends": ends, "refuse": refuse}
    options = {"num_clients": instances, "max_wrong_samples_per_step": 100, "env_kwargs": kwargs}
    with make(**options) as source:
        parts = [
            {name: values.copy() for name, values in source.batch(size).items()} for size in batches
        ]
    rows = expected(sum(batches), instances, ends, refuse)
    assert np.concatenate([part["x"] for part in parts]).tolist() == [row for _, row in rows]
    episodes = np.concatenate([part["episode"] for part in parts])
    assert episodes.tolist() == [episode for episode, _ in rows]


@given(**CHAPTERS)
@settings(max_examples=sizes.size(60, 20))
def test_rows_of_an_episode_follow_from_its_number(**case):
    check_chapters(lambda **options: open_local(None, "Chapters", **options), **case)


@pytest.mark.slow
@given(**CHAPTERS)
@settings(max_examples=sizes.size(20, 5), phases=[Phase.explicit, Phase.generate])
def test_clients_make_the_same_rows(**case):
    from simulated import Simulation

    from physx_core.sources import ClientSource

    def make(**options):
        options = {"launcher": "simulated:SimulatedLauncher", **options}
        config = EnvironmentConfig(named("Chapters"), **options)
        return ClientSource(config, None, [SEED], transport=simulation)

    with Simulation() as simulation:
        check_chapters(make, **case)


# One by one --------------------------------------------------------------------------------------


def rows_of(services, environment, count, name="x", **options):
    with open_local(services, environment, **options) as source:
        return source.batch(count)[name].copy()


@pytest.mark.slow
@pytest.mark.parametrize("instances", [1, 2, 3])
def test_single_steps_have_the_parameters_and_the_stream_of_their_number(services, instances):
    options = {"num_clients": instances, "sampler": "physx/sobol"}
    with open_local(services, "Single", **options) as source:
        rows = source.batch(12)
    assert rows["x"].tolist() == [stream(number).random() for number in range(12)]
    with open_local(services, "Single", sampler="physx/sobol") as source:
        assert rows["p"].tolist() == source.batch(12)["p"].tolist()
    assert len(set(rows["p"].tolist())) == 12


def test_the_configuration_gives_the_number_of_rows(services):
    rows = rows_of(services, "Walk", 6, "n", episode_steps=3)
    assert rows.tolist() == [0, 1, 2, 0, 1, 2]
    walks = rows_of(services, "Walk", 6, episode_steps=3)
    numbers = [stream(number).normal(size=3) for number in (0, 1)]
    assert walks.tolist() == np.concatenate([np.cumsum(one) for one in numbers]).tolist()


def test_rejected_steps_do_not_count(services):
    options = {"episode_steps": 2, "max_wrong_samples_per_step": 100}
    kwargs = {"refuse": 2, "ends": "never"}
    with open_local(services, "Chapters", env_kwargs=kwargs, **options) as source:
        rows = source.batch(8)
    episodes = rows["episode"].tolist()
    assert max(episodes.count(episode) for episode in episodes) == 2
    assert len(set(episodes)) >= 4
    kwargs = {"refuse": 1}
    with (
        open_local(services, "Chapters", env_kwargs=kwargs) as source,
        pytest.raises(WrongSamplesError),
    ):
        source.batch(1)


def test_an_end_within_sub_steps_is_that_of_the_row(services):
    options = {"simulations_per_step": 3, "independent_episodes": True}
    kwargs = {"sub_steps_end": True}
    rows = rows_of(services, "Walk", 4, "n", env_kwargs=kwargs, **options)
    assert rows.tolist() == [0, 0, 0, 0]


def test_steps_of_rows_and_drawings_go_on_in_the_next_episode(services):
    options = {"visualizer": "rerun", "num_clients": 1}
    with open_local(services, "Chapters", **options) as source:
        rows = source.batch(20)
    assert rows["step"].tolist() == list(range(20))
    assert rows["x"][:, 2].max() < 4
    shown = [step for _, step, _ in services.shown]
    assert shown == [0, *range(20)]


def test_replayed_rows_end_no_episode(services):
    stored = {"x": np.arange(6.0)}
    with open_local(services, "Walk", episode_steps=2) as source:
        rows = source.batch(6, stored)
        assert rows["episode"].tolist() == [0] * 6
        assert rows["x"].tolist() == np.cumsum(np.arange(6.0)).tolist()


# Mistakes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mistake", "independent", "said"),
    [
        ("begins the next", True, r"Mistaken has independent episodes, but called new_episode\(\)"),
        ("ends", False, r"Mistaken called end_episode\(\), but is a stream: call new_episode"),
        ("replaces rng", True, "Mistaken has replaced self.rng, but its episodes are independent"),
        ("is empty", True, "Mistaken ended 1000 episodes in a row without a row"),
    ],
)
def test_mistakes_are_named(services, mistake, independent, said):
    kwargs = {"mistake": mistake, "independent": independent}
    with (
        open_local(services, "Mistaken", env_kwargs=kwargs) as source,
        pytest.raises(UsageError, match=said),
    ):
        source.batch(1)


def test_a_generator_of_numbered_streams_spawns_no_others(services):
    with (
        open_local(services, "Mistaken", env_kwargs={"mistake": "spawns"}) as source,
        pytest.raises(EnvironmentFailedError, match="does not implement spawning"),
    ):
        source.batch(1)


@pytest.mark.parametrize("option", [{"independent_episodes": True}, {"episode_steps": 4}])
def test_a_configuration_cannot_say_it_for_every_environment(services, option):
    source = open_local(services, "Blank", **option)
    with pytest.raises(UsageError, match=r"Blank.*does not implement reset_parameters\(\)"):
        source.open()
    kwargs = {"mistake": "uses rng early", "independent": False}
    source = open_local(services, "Mistaken", env_kwargs=kwargs, **option)
    with pytest.raises(UsageError, match="uses self.rng before it can know"):
        source.open()
