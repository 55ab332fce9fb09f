"""Trainings while environments generate their samples: the same in process and with clients."""

from __future__ import annotations

import itertools
import os
import random
import signal
import threading
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sizes import seed, trials

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Training,
    Visualizer,
    checkpoint,
)
from physx_core.cli import main
from physx_core.errors import ConfigError, EnvironmentFailedError
from physx_core.pipelines import read_drawn_rows
from physx_core.sources import client_source
from physx_core.toy import Linear

pytestmark = pytest.mark.processes

PROGRAM = Path(__file__).parents[1] / "programs" / "online_run.py"
PUPIL = f"{PROGRAM.with_name('online_envs.py')}:Pupil"


class Recording(Linear):
    """Notes how many samples it predicts at once, and in which thread; rounds each alone."""

    calls: list = []  # noqa: RUF012 - of all networks, cleared by each training

    def forward(self, *inputs):
        self.calls.append((len(inputs[0]), threading.current_thread() is threading.main_thread()))
        rows = self.rows(dict(zip(self.net_fields, inputs, strict=True)))
        return sum(rows[:, [i]] * weights for i, weights in enumerate(self.weights))


class Recorded(Training):
    """Notes all that batches hold and what they are normalized with."""

    def train_begin(self):
        self.seen = []
        Recording.calls.clear()

    def optimize(self):
        super().optimize()
        normalization = self.learner.transformation.normalization
        means = {name: np.array(item.mean) for name, item in normalization.items()}
        rows = {name: array.copy() for name, array in self.batch.items()}
        self.seen.append((rows, means, dict(self.losses)))


def pupil(over_tcp=True, *, instances=3, delay=0.0, retries=0, **options):
    named = ("asks", "refuse", "fails_at", "kill_at")
    kwargs = {name: options.pop(name) for name in named if name in options}
    return EnvironmentConfig(
        PUPIL,
        env_kwargs={**kwargs, "delay": delay},
        as_tcp_ip_client=over_tcp,
        num_clients=instances,
        seed=4,
        retries=retries,
        **options,
    )


def training(config, name, *, cls=Recorded, **options):
    chosen = {"epoch_nb": 2, "batch_nb": 8, "batch_size": 7, "seed": 3, "quiet": True, **options}
    network = NetworkConfig(
        Recording,
        optimization=f"{PROGRAM}:Descending",
        network_kwargs={"net_fields": "x", "opt_fields": "y"},
    )
    return cls(network, DatasetConfig(normalize=True), config, session_name=name, **chosen)


def stored(name):
    with Dataset.open(f"sessions/{name}") as dataset:
        assert dataset.verify() == []
        return {
            mode: {f: dataset[mode][f][:] for f in dataset.fields(mode)} for mode in dataset.modes
        }


def same(one, other):
    """Check that two trees of dictionaries, lists and arrays are equal, bit for bit."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for name in one:
            same(one[name], other[name])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            same(a, b)
    else:
        np.testing.assert_array_equal(one, other)


def scalars(name):
    """Return the recorded numbers, without the times."""
    lines = Path(f"sessions/{name}/stats/scalars.csv").read_text().splitlines()
    return [line for line in lines if ",online/" not in line]


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"asks": True}, marks=pytest.mark.faults),
        {"asks": True, "refuse": 3, "record_wrong_samples": True},
        pytest.param({"always_produce": True, "instances": 2}, marks=pytest.mark.faults),
    ],
    ids=str,
)
def test_online_training_is_independent_of_clients_and_speed(
    options, nothing_stays_behind, monkeypatch
):
    runs, calls = [], []
    for name, over_tcp, delay in (("local", False, 0), ("quick", True, 0), ("late", True, 0.02)):
        if name == "late":  # the others as if no client ran ahead
            monkeypatch.setattr(client_source, "_AHEAD_ROWS", 1 << 16)
        elif over_tcp:
            monkeypatch.setattr(client_source, "_AHEAD_ROWS", 0)
        run = training(pupil(over_tcp, delay=delay, **options), name)
        run.execute()
        runs.append((run.seen, stored(name), run.learner.network.weights, scalars(name)))
        calls.append(list(Recording.calls))
    same(runs[0], runs[1])
    same(runs[0], runs[2])
    assert calls[1] == calls[2]  # the same requests are answered together
    assert all(in_main_thread for sizes in calls for _, in_main_thread in sizes)


def test_environments_generate_while_the_network_learns(nothing_stays_behind):
    counts = []

    class Slow(Training):
        def batch_end(self):
            super().batch_end()
            deadline = time.monotonic() + 60
            dataset = self.data.dataset
            while dataset.num_samples("training") < 56 and time.monotonic() < deadline:
                time.sleep(0.01)
            counts.append(dataset.num_samples("training"))

    run = training(pupil(), "slow", cls=Slow, epoch_nb=1)
    run.execute()
    assert counts == [56] * 8


@pytest.mark.parametrize("over_tcp", [False, True])
def test_a_training_that_decides_itself_when_an_epoch_ends_generates_no_more_than_it_takes(
    over_tcp, nothing_stays_behind
):
    class Short(Recorded):
        def batch_condition(self):
            return super().batch_condition() and self.batch_id < 3

    run = training(pupil(over_tcp), "short", cls=Short, epoch_nb=1)
    run.execute()
    assert len(run.seen) == 3 and len(stored("short")["training"]["x"]) == 21


@pytest.mark.parametrize("over_tcp", [False, True])
@pytest.mark.parametrize(
    "options", [{"fails_at": 12}, {"fails_at": 0}, {"fails_at": 12, "asks": True}]
)
def test_environment_error_is_raised_at_its_batch(over_tcp, options, nothing_stays_behind):
    """Instance 3 fails at its 13th row, which is number 38 and so in the sixth batch."""
    run = training(pupil(over_tcp, **options), "failed")
    with pytest.raises(EnvironmentFailedError, match="no more beans"):
        run.execute()
    batches = 5 if options["fails_at"] else 0
    assert len(run.seen) == batches == run.batch_id
    rows = stored("failed") if Path("sessions/failed/dataset").exists() else {}
    assert len(rows.get("training", {"x": ()})["x"]) == 7 * batches
    assert (run.checkpoint_path is not None) == (batches > 0)
    assert "physx-feeder" not in {thread.name for thread in threading.enumerate()}


def test_prediction_error_during_online_training_is_raised(nothing_stays_behind, monkeypatch):
    answers = []

    def predict(self, batch):
        answers.append(threading.current_thread() is threading.main_thread())
        if len(answers) > 4:
            raise OverflowError("too much")
        return {"y": np.zeros((len(batch["x"]), 1))}

    monkeypatch.setattr(
        "physx_core.pipelines.learning.learner.Learner.predict_in_training", predict
    )
    with pytest.raises(OverflowError, match="too much"):
        training(pupil(asks=True), "failed").execute()
    assert answers == [True] * 5


def test_client_restart_does_not_change_online_training(nothing_stays_behind):
    runs = []
    for name, options in (("whole", {}), ("broken", {"kill_at": 9, "retries": 1, "delay": 0.01})):
        run = training(pupil(asks=True, **options), name)
        run.execute()
        runs.append((run.seen, stored(name), run.learner.network.weights))
    assert Path("killed").exists()
    same(*runs)


class Watching(Visualizer):
    """Notes who calls it, and what it is shown before which batch."""

    noted: list = []  # noqa: RUF012 - read by the test

    def open(self, run_name, session_dir, instance_nb):
        self.noted.clear()

    def events(self, instance_id, step, events):
        self.noted.append(("events", instance_id, step))
        assert threading.current_thread() is threading.main_thread()

    def scalars(self, values, step, timeline):
        self.noted.append((timeline, step))


@pytest.mark.parametrize("over_tcp", [False, True])
def test_viewers_are_called_in_the_main_thread_and_see_a_batch_before_it_is_learned_from(
    over_tcp, nothing_stays_behind
):
    training(pupil(over_tcp, visualizer=Watching), "seen", epoch_nb=1).execute()
    noted = list(Watching.noted)
    shown = [entry for entry in noted if entry[0] == "events"]
    assert len({entry[1:] for entry in shown if entry[2] >= 0}) >= 56
    for batch in range(1, 9):
        before = noted[: noted.index(("batch", batch))]
        steps = {entry[1:] for entry in before if entry[0] == "events"}
        for row in range(7 * batch):
            assert (row % 3 + 1, row // 3) in steps


# Resumed ------------------------------------------------------------------------------------------


class Stopped(Recorded):
    """Is interrupted after some batches, as by Ctrl-C."""

    stop_after = 5

    def batch_end(self):
        super().batch_end()
        if len(self.seen) == self.stop_after:
            os.kill(os.getpid(), signal.SIGINT)


def result(run, name):
    numbers = plain(run.learner.transformation.normalization)
    return stored(name), run.learner.network.weights, numbers


def plain(normalization):
    return {
        field: {name: values.tobytes() for name, values in item.arrays().items()}
        for field, item in normalization.items()
    }


REFUSING = {"refuse": 3, "record_wrong_samples": True}


@pytest.mark.parametrize(
    ("over_tcp", "always", "options"),
    [  # each pair of settings; the others are campaigns
        (False, False, REFUSING),
        (False, True, {}),
        (True, False, {}),
        (True, True, REFUSING),
        pytest.param(False, False, {}, marks=pytest.mark.faults),
        pytest.param(False, True, REFUSING, marks=pytest.mark.faults),
        pytest.param(True, False, REFUSING, marks=pytest.mark.faults),
        pytest.param(True, True, {}, marks=pytest.mark.faults),
    ],
    ids=str,
)
def test_interrupted_online_training_resumes_bit_identically(
    over_tcp, always, options, nothing_stays_behind
):
    config = pupil(over_tcp, delay=0.01, always_produce=always, **options)
    whole = training(config, "whole")
    whole.execute()
    stop = training(config, "stopped", cls=Stopped)
    stop.stop_after = 11 if always else 5
    with pytest.raises(KeyboardInterrupt):
        stop.execute()
    first = len(stored("stopped")["training"]["x"])
    assert first >= 7 * stop.stop_after
    assert over_tcp or first == 7 * stop.stop_after
    again = training(config, "stopped", resume=True)
    again.execute()
    same(stop.seen + again.seen, whole.seen)
    same(result(again, "stopped"), result(whole, "whole"))


def test_other_runs_may_add_to_the_session_of_a_training_whose_samples_are_all_there(
    nothing_stays_behind,
):
    class Ahead(Stopped):
        def batch_end(self):
            deadline = time.monotonic() + 60
            while self.data.dataset.num_samples("training") < 56 and time.monotonic() < deadline:
                time.sleep(0.01)
            super().batch_end()

    def add(mode):
        spring = pupil(False, instances=2, refuse=5, record_wrong_samples=True)
        DataGeneration(
            spring, session_name="stopped", new_session=False, batch_nb=2, batch_size=7, mode=mode,
            quiet=True,
        ).execute()  # fmt: skip

    config = pupil(delay=0.01, refuse=3, record_wrong_samples=True)
    whole = training(config, "whole", epoch_nb=1)
    whole.execute()
    stop = training(config, "stopped", cls=Ahead, epoch_nb=1)
    with pytest.raises(KeyboardInterrupt):
        stop.execute()
    add("training")
    add("validation")
    again = training(config, "stopped", epoch_nb=1, resume=True, validation_every=0)
    again.execute()
    same(stop.seen + again.seen, whole.seen)
    same(again.learner.network.weights, whole.learner.network.weights)
    rows, expected = stored("stopped")["training"], stored("whole")["training"]
    same({name: values[:56] for name, values in rows.items()}, expected)
    assert len(rows["x"]) == 56 + 14


@pytest.mark.parametrize("mode", ["training", "validation"])
def test_a_training_whose_samples_are_not_all_there_resumes_if_no_others_follow_them(mode):
    config = pupil(False)
    whole = training(config, "whole", epoch_nb=1)
    whole.execute()
    stop = training(config, "stopped", cls=Stopped, epoch_nb=1)
    with pytest.raises(KeyboardInterrupt):
        stop.execute()
    DataGeneration(
        pupil(False, instances=2), session_name="stopped", new_session=False, batch_nb=2,
        batch_size=7, mode=mode, quiet=True,
    ).execute()  # fmt: skip
    again = training(config, "stopped", epoch_nb=1, resume=True, validation_every=0)
    if mode == "validation":
        again.execute()
        same(stop.seen + again.seen, whole.seen)
    else:
        with pytest.raises(ConfigError, match="35 of 56 exist, and other runs have added"):
            again.execute()


def last_checkpoint(name):
    found = checkpoint.find(Path(f"sessions/{name}"), None, -1)
    with zipfile.ZipFile(found.path / "parameters.npz") as file:
        weights = file.read("weights.npy")
    # Which files hold the rows depends on when the training was killed.
    rows = {mode: each["rows"] for mode, each in found.progress.data.items()}
    seen = {mode: each[""][0] for mode, each in found.progress.snapshots.items()}
    progress = replace(found.progress, data=rows, snapshots=seen)
    return weights, plain(found.normalization), progress


def survives(run_killed, random, kills, words):
    """Check trainings that are killed at random moments, so often in all, against a whole one."""

    def killed(name, moments):
        return run_killed(str(PROGRAM), Path.cwd(), moments, name, *words, "sobol")

    _, whole = killed("whole", [])
    for number in itertools.count():
        name = f"killed{number}"
        kills -= killed(name, [whole * random.uniform(0.2, 1.1) for _ in range(5)])[0]
        same(stored(name), stored("whole"))
        assert last_checkpoint(name) == last_checkpoint("whole")
        if words[2] != "stream":
            same(read_drawn_rows(f"sessions/{name}"), read_drawn_rows("sessions/whole"))
        if kills <= 0:
            return


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("clients", "once", "stream"),
        pytest.param(("clients", "always", "reservoir"), marks=pytest.mark.faults),
        pytest.param(("clients", "once", "fifo"), marks=pytest.mark.faults),
        pytest.param(("local", "once", "window"), marks=pytest.mark.faults),
    ],
    ids=" ".join,
)
def test_killed_online_training_resumes_bit_identically(words, run_killed):
    survives(run_killed, random.Random(1), trials(2, 1), words)


@pytest.mark.faults
@pytest.mark.parametrize(
    ("words", "kills"),
    [(("clients", "once", "fifo"), 10), (("clients", "always", "stream"), 5)],
    ids=["clients once fifo", "clients always stream"],
)
def test_online_training_killed_at_random_moments(words, kills, run_killed):
    survives(run_killed, random.Random(seed()), trials(kills, 3), words)


def test_resume_command_uses_environments_of_session(capfd, nothing_stays_behind):
    spring = EnvironmentConfig("toy/spring", num_clients=2)
    options = {"epoch_nb": 2, "batch_nb": 8, "batch_size": 7, "quiet": True}
    network = NetworkConfig("toy/linear")
    with pytest.raises(KeyboardInterrupt):
        Stopped(network, None, spring, session_name="stopped", seed=3, **options).execute()
    assert main(["train", "sessions/stopped", "--resume"]) == 0
    assert "2 of 2 epochs" in capfd.readouterr().err
    Training(network, None, spring, session_name="whole", seed=3, **options).execute()
    same(stored("stopped"), stored("whole"))
