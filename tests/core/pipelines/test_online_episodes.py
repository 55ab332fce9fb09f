"""Trainings on independent episodes that are simulated meanwhile: by number, whoever simulates."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path

import numpy as np
import online_lessons
import pytest
from online_lessons import LESSON, RESERVOIR, result, train
from sizes import seed, trials

from physx_core import DataGeneration, Dataset, EnvironmentConfig, Training
from physx_core.dataset import EpisodeStatus
from physx_core.errors import FailedEpisodesError, UsageError

pytestmark = pytest.mark.processes

PROGRAM = Path(online_lessons.__file__)


def simulated():
    """Return how often each episode was begun and ended."""
    lines = [line.split() for line in Path("simulated.txt").read_text().splitlines()]
    return [Counter(int(n) for what, n in lines if what == each) for each in ("begun", "ended")]


@pytest.mark.parametrize(
    "training",
    [{}, RESERVOIR, {"epoch_nb": 3}, pytest.param({"epoch_nb": 2}, id="always")],
    ids=str,
)
def test_network_does_not_depend_on_the_number_of_clients(training, request):
    always = "always" in request.node.name
    options = {"training": training, "always_produce": always}
    expected = result(train("local", **options))
    for clients in (1, 2, 3):
        run = train(f"clients_{clients}", clients, delay=0.01, **options)
        assert result(run) == expected, clients


def test_rows_are_those_that_the_batches_need():
    run = train("run", 2, training=RESERVOIR)
    rows = run.data.online._buffer.total
    with Dataset.open(run.session.dataset_dir) as dataset:
        assert dataset.num_samples("training") == rows
        numbers = dataset["training"]["episode"][:]
        assert (np.diff(numbers) >= 0).all()
        known = dataset.recorded_episodes("training")
        assert EpisodeStatus(known.status[-1]) in (EpisodeStatus.FINISHED, EpisodeStatus.CUT)


def test_dead_client_costs_the_episode_that_it_was_simulating():
    expected = result(train("whole", 2))
    before, _ = simulated()
    Path("simulated.txt").unlink()
    assert result(train("died", 2, dies=(2, 5), delay=0.01)) == expected
    begun, _ = simulated()
    assert {2, 5} <= {number for number, count in begun.items() if count == 2}
    assert sum(begun.values()) <= sum(before.values()) + 2 + 4


def test_episodes_may_fail():
    with pytest.raises(FailedEpisodesError, match="no more beans"):
        train("failed", 2, fails=(3,))
    found = [result(train(f"run{n}", n, fails=(3, 4), training={"max_failed": 2})) for n in (0, 2)]
    assert found[0] == found[1]


@pytest.mark.parametrize("every", [0, 2])
def test_interrupted_training_simulates_what_has_no_record(every):
    class Stopped(Training):
        def batch_end(self):
            if self.batch_id == 4:
                raise KeyboardInterrupt

    expected = result(train("whole", 2, training=RESERVOIR, state_every=every))
    Path("simulated.txt").unlink()
    options = {"delay": 0.02, "state_every": every}
    with pytest.raises(KeyboardInterrupt):
        train("stopped", 2, cls=Stopped, training=RESERVOIR, **options)
    run = train("stopped", 3, training={**RESERVOIR, "resume": True}, **options)
    assert result(run) == expected
    begun, ended = simulated()
    assert sum(begun.values()) <= len(ended) + 2 * (2 + 3)


def killed(run_killed, tmp_path, moments, environment, buffer, clients):
    """Return the results of a training, and of one that is killed at shares of its duration."""
    program = str(PROGRAM)
    folders = [tmp_path / name for name in ("whole", "killed")]
    for folder in folders:
        folder.mkdir()
    _, duration = run_killed(program, folders[0], [], environment, buffer, "2")
    times = [duration * moment for moment in moments]
    run_killed(program, folders[1], times, environment, buffer, clients)
    return [(folder / "result.txt").read_text() for folder in folders]


@pytest.mark.faults
@pytest.mark.parametrize("buffer", ["stream", "reservoir"])
@pytest.mark.parametrize("clients", ["1", "2", "3"])
def test_training_killed_at_random_moments(tmp_path, buffer, clients, run_killed, monkeypatch):
    moments = np.random.default_rng(seed()).uniform(0.3, 0.9, trials(10, 3))
    found = killed(run_killed, tmp_path, moments, "lesson", buffer, clients)
    assert found[0] == found[1]
    monkeypatch.chdir(tmp_path / "killed")
    begun, ended = simulated()
    assert sum(begun.values()) <= len(ended) + (len(moments) + 1) * int(clients) * 8


@pytest.mark.faults
@pytest.mark.parametrize("clients", ["1", "2", "3"])
def test_heat_training_killed_at_random_moments(tmp_path, clients, run_killed):
    moments = np.random.default_rng(seed()).uniform(0.2, 0.9, trials(30, 3))
    found = killed(run_killed, tmp_path, moments, "heat", "reservoir", clients)
    assert found[0] == found[1]


def test_independent_episode_cannot_ask_the_network_that_learns():
    with pytest.raises(UsageError, match="independent_episodes=False"):
        train("asks", 2, asks=True)
    run = train("stream", 2, asks=True, independent_episodes=False)
    assert "parameters" in run.data.dataset.modes


def test_clients_join_a_training(nothing_stays_behind):
    expected = result(train("whole", 1))
    run = train("joined", 1, min_clients=1, max_clients=3, delay=0.01)
    assert result(run) == expected


def test_error_of_the_training_ends_clients_that_run_ahead(nothing_stays_behind):
    class Failing(Training):
        def batch_begin(self):
            if self.batch_id == 3:
                time.sleep(0.3)
                raise RuntimeError("on purpose")

    with pytest.raises(RuntimeError, match="on purpose"):
        train("failing", 2, cls=Failing)
    assert Path("sessions/failing/dataset").is_dir()


def test_failures_of_episodes_that_no_batch_needs_do_not_count():
    expected = result(train("whole", 1))
    with Dataset.open("sessions/whole/dataset") as dataset:
        surplus = [*range(int(dataset["training"]["episode"][-1]) + 1, 200)]
    for clients in (0, 2):
        run = train(f"run_{clients}", clients, fails=surplus)
        assert result(run) == expected
        with Dataset.open(run.session.dataset_dir) as dataset:
            assert dataset.failed_episodes("training") == []


@pytest.mark.slow
def test_resumed_training_may_have_more_failures():
    options = {"batch_nb": 20}
    lesson = {"fails": (20, 21), "delay": 0.01}
    expected = result(train("whole", 1, training={**options, "max_failed": 2}, **lesson))
    with pytest.raises(FailedEpisodesError, match="--max-failed"):
        train("run", 1, training=options, **lesson)
    options |= {"resume": True, "max_failed": 2}
    assert result(train("run", 2, training=options, retries=0, **lesson)) == expected


def test_rejected_samples_do_not_depend_on_the_number_of_clients():
    runs = [train(f"run_{n}", n, rejects=0.3, record_wrong_samples=True) for n in (0, 1, 3)]
    found = []
    for run in runs:
        with Dataset.open(run.session.dataset_dir) as dataset:
            found.append({name: dataset["wrong"][name][:].tobytes() for name in dataset["wrong"]})
    assert found[0]["x"]
    assert found == [found[0]] * 3


@pytest.mark.parametrize("clients", [0, 2])
def test_resumed_training_leaves_out_surplus_episodes_that_a_sampler_chose_before(clients):
    class Stopped(Training):
        def batch_end(self):
            if self.batch_id == self.batch_nb:
                raise OSError("on purpose")

        def _save_after(self, error):
            pass  # killed

    options = {"sampler": "physx/active", "training": {"run_ahead": 1000}}
    expected = result(train("whole", clients, **options))
    with pytest.raises(OSError, match="on purpose"):
        train("run", clients, cls=Stopped, **options)
    options["training"] |= {"resume": True}
    assert result(train("run", clients, **options)) == expected


def test_episodes_follow_the_rows_of_a_stream():
    expected = result(train("alone", 2))
    config = EnvironmentConfig(
        LESSON, {"plain": True}, as_tcp_ip_client=False, independent_episodes=False, seed=1
    )
    DataGeneration(config, batch_nb=3, batch_size=10, session_name="run", quiet=True).execute()
    with Dataset.open("sessions/run") as dataset:
        stream = dataset["training"]["x"][:]
    options = {"new_session": False, "epoch_nb": 2}
    run = train("run", 2, training=options)
    with Dataset.open("sessions/run") as dataset:
        found = dataset["training"]["x"][:]
    assert np.array_equal(found[:30], stream)
    assert found[30:].nbytes == len(expected["x"])
    assert run.epoch_id == 2
