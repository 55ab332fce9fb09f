"""Batches of independent episodes: as many rows as asked for, whoever simulates them."""

from __future__ import annotations

import dataclasses
import itertools
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from campaigns import TROUBLED, rows_of

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.dataset import EpisodeStatus
from physx_core.errors import FailedEpisodesError, MissingFieldError, PluginNotFoundError

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("nothing_stays_behind")]

SEED = 3
CONFIG = EnvironmentConfig(TROUBLED, as_tcp_ip_client=False, seed=SEED)


def generate(batches, size=5, name="run", *, clients=0, env_kwargs=None, config=CONFIG, **options):
    """Generate batches in a session of this name, in this process or in some clients."""
    config = dataclasses.replace(
        config,
        env_kwargs=env_kwargs or {},
        as_tcp_ip_client=clients > 0,
        num_clients=max(1, clients),
    )
    options = {"session_name": name, "batch_nb": batches, "batch_size": size, **options}
    run = DataGeneration(config, **options)
    run.execute()
    return run


def stored(name="run"):
    """Return the rows of a session, and number to status of its episodes that have rows."""
    with Dataset.open(f"sessions/{name}") as dataset:
        assert dataset.verify() == []
        known = dataset.recorded_episodes("training")
        status = {}
        for first, count, which, rows in zip(
            known.episode.tolist(), known.numbers.tolist(), known.status.tolist(),
            known.rows.tolist(), strict=True,
        ):  # fmt: skip
            if rows:
                status |= dict.fromkeys(range(first, first + count), which)
        return dataset["training"]["x"][:].tolist(), status


def expected(count, troubles=None, **options):
    """Return the first rows of all episodes, in order."""
    rows = (rows_of(number, [SEED, 0, 0], troubles, **options) for number in itertools.count())
    return list(itertools.islice(itertools.chain.from_iterable(r or [] for r in rows), count))


@pytest.mark.parametrize("clients", [0, 1, 2, 3])
@pytest.mark.parametrize("options", [{}, {"parameters": True, "least": 1}, {"least": 3, "most": 9}])
def test_rows_are_those_of_the_first_episodes(clients, options):
    generate(7, clients=clients, env_kwargs=options)
    rows, status = stored()
    size = {name: value for name, value in options.items() if name != "parameters"}
    assert rows == expected(35, **size)
    assert set(list(status.values())[:-1]) <= {EpisodeStatus.FINISHED}


@pytest.mark.parametrize("clients", [0, 2])
def test_last_episode_is_cut_and_completed_by_more_batches(clients):
    kwargs = {"least": 4, "most": 4}
    generate(3, clients=clients, env_kwargs=kwargs)
    rows, status = stored()
    assert rows == expected(15, **kwargs)
    assert status == {0: 0, 1: 0, 2: 0, 3: EpisodeStatus.CUT}
    generate(6, clients=clients, env_kwargs=kwargs, resume=True)
    rows, status = stored()
    assert rows == expected(30, **kwargs)
    assert status == dict.fromkeys(range(7), 0) | {7: EpisodeStatus.CUT}


def test_fewer_batches_lose_nothing():
    generate(6, env_kwargs={"least": 4, "most": 4})
    before = stored()
    for batches in (3, 2):
        generate(batches, env_kwargs={"least": 4, "most": 4}, resume=True)
        assert stored() == before


def test_batches_follow_the_rows_of_a_stream():
    for independent in (False, True):
        config = dataclasses.replace(CONFIG, independent_episodes=independent)
        generate(4, config=config, new_session=False)
    assert len(stored()[0]) == 40


@pytest.mark.parametrize("clients", [0, 2])
def test_episodes_of_one_row_are_cut_between_two(clients):
    config = dataclasses.replace(CONFIG, episode_steps=1)
    kwargs = {"least": 1}
    generate(3, 7, clients=clients, env_kwargs=kwargs, config=config)
    rows, status = stored()
    assert rows == expected(21, least=1, episode_steps=1)
    assert status == dict.fromkeys(range(21), 0)


def test_batches_of_a_longer_run_begin_with_those_of_a_shorter_one():
    for batches in (2, 9):
        generate(batches, name=f"run{batches}", env_kwargs={"least": 1})
    assert stored("run9")[0][:10] == stored("run2")[0]


def test_episodes_that_fail_are_passed_over():
    troubles = {"1": ["raises", 0], "4": ["is not finite", 0]}
    kwargs = {"troubles": troubles, "least": 1}
    generate(4, clients=2, env_kwargs=kwargs, max_failed=2)
    assert stored()[0] == expected(20, troubles, least=1)
    with pytest.raises(FailedEpisodesError):
        generate(4, name="other", env_kwargs=kwargs, max_failed=1)


def test_another_run_adds_other_rows():
    generate(2, env_kwargs={"least": 1})
    generate(2, env_kwargs={"least": 1}, new_session=False)
    with Dataset.open("sessions/run") as dataset:
        rows = dataset["training"]["x"][:].tolist()
        assert sorted(set(dataset.recorded_episodes("training").campaign.tolist())) == [0, 1]
    second = [rows_of(number, [SEED, 0, 10], least=1) for number in range(10)]
    assert rows == expected(10, least=1) + list(itertools.chain.from_iterable(second))[:10]


def test_events_of_batches_are_called_and_each_batch_is_stored_when_it_ends():
    seen = []

    class Watched(DataGeneration):
        def batch_end(self):
            seen.append((self.batch_id, self.dataset.num_samples("training") >= 5 * self.batch_id))

    config = dataclasses.replace(CONFIG, env_kwargs={"least": 1})
    Watched(config, session_name="run", batch_nb=3, batch_size=5).execute()
    assert seen == [(1, True), (2, True), (3, True)]


def test_run_that_ends_early_has_the_rows_of_its_batches():
    class Short(DataGeneration):
        def batch_condition(self):
            return self.batch_id < 2

    config = dataclasses.replace(CONFIG, env_kwargs={"least": 1})
    Short(config, session_name="run", batch_nb=9, batch_size=5).execute()
    assert stored()[0] == expected(10, least=1)


def test_open_run_generates_more_batches_each_time():
    config = dataclasses.replace(CONFIG, env_kwargs={"least": 1})
    with DataGeneration(config, session_name="run", batch_nb=2, batch_size=5) as run:
        for _ in range(3):
            run.execute()
        assert run.batch == {}
    assert stored()[0] == expected(30, least=1)


def test_error_before_the_first_row_is_the_one_that_is_raised():
    config = dataclasses.replace(CONFIG, environment="no/environment")
    with pytest.raises(PluginNotFoundError):
        DataGeneration(config, session_name="run", batch_nb=2, batch_size=5).execute()
    troubles = {"0": ["lacks a field", 0]}
    with pytest.raises(MissingFieldError):
        generate(2, env_kwargs={"troubles": troubles, "least": 1})


def test_replaced_production_of_batches_gets_a_stream():
    class Own(DataGeneration):
        def batch_produce(self):
            self.dataset.append("training", self.source.batch(self.batch_size))

    config = dataclasses.replace(CONFIG, env_kwargs={"least": 1})
    Own(config, session_name="run", batch_nb=3, batch_size=5).execute()
    with Dataset.open("sessions/run") as dataset:
        assert dataset.num_samples("training") == 15
        assert dataset.recorded_episodes("training") is None


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_interrupted_batches_are_resumed_without_repeating_what_has_ended(how):
    kwargs = {"least": 1, "sleep": 0.03, "log": "log"}
    command = [sys.executable, "-m", "physx_core", "generate", TROUBLED]
    command += ["--batch-nb", "1", "--batch-size", "200", "--session-name", "run"]
    command += ["--environment.num-clients", "2", "--environment.seed", str(SEED)]
    command += ["--no-prove-independence"]  # each number is to be simulated once
    given = [f"{name}={value!r}" for name, value in kwargs.items()]
    command += ["--environment.env-kwargs", *given]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not Path("log").exists() or len(Path("log").read_text().split()) < 16:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    time.sleep(1.2)  # what has ended is on the disk by then
    before = len(Path("log").read_text().split())
    process.send_signal(how)
    process.wait()
    assert len(stored()[0]) > 0
    subprocess.run(
        [*command[:4], "sessions/run", "--resume"], check=True, stderr=subprocess.DEVNULL
    )
    assert stored()[0] == expected(200, least=1)
    numbers = Path("log").read_text().split()
    again = len(numbers) - len(set(numbers))
    assert again <= 2 + sum(status == EpisodeStatus.CUT for status in stored()[1].values())
    assert before < len(numbers)
    assert [path.name for path in Path("sessions").iterdir()] == ["run"]
