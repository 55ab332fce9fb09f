"""DataGeneration whose clients write their rows: the dataset of the server, bit for bit."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
from pathlib import Path

import h5py
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
)
from physx_core.dataset import EPISODES, EpisodeStatus
from physx_core.errors import (
    ConfigError,
    DatasetError,
    PhysxError,
    UsageError,
)
from physx_core.pipelines import Replay

pytestmark = [pytest.mark.processes, pytest.mark.usefixtures("nothing_stays_behind")]

PROGRAM = Path(__file__).parents[1] / "programs" / "writer_envs.py"
WALKS = f"{PROGRAM}:Walks"
FEW = {"episodes": 30}
COUNTED = ("training", "validation", "wrong")


def generate(name, writers="clients", environment=WALKS, *, options=FEW, **settings):
    """Simulate episodes with partitions of few rows; return the session's folder."""
    settings = {"num_clients": 2, "seed": 3, "record_wrong_samples": True, **settings}
    size = settings.pop("file_size", 2e-5)
    with DataGeneration(
        EnvironmentConfig(environment, **settings),
        DatasetConfig(writers=writers, max_file_size=size),
        session_name=name,
        quiet=True,
        **options,
    ) as run:
        run.execute()
    return run.session.path


def contents(folder):
    """Return everything that readers may depend on: rows, episodes, statistics."""
    found = {}
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        for mode in (mode for mode in COUNTED if mode in dataset):
            known = dataset.recorded_episodes(mode)
            is_cut = known.status == EpisodeStatus.CUT  # how many are, beyond the rows, is chance
            ended = np.flatnonzero((known.rows > 0) | ~is_cut)
            values = dataset.recorded_values(mode, ended)
            found[mode] = (
                {name: view[:].tobytes() for name, view in dataset[mode].items()},
                [column[ended].tolist() for column in known],
                {name: np.asarray(each).tobytes() for name, each in values.items()},
                {
                    name: [array.tobytes() for array in (each.mean, each.std)]
                    for name, each in dataset.normalization_of(mode).items()
                },
            )
        found["fields"] = {mode: dataset.fields(mode) for mode in (*found, EPISODES)}
    return found


# The same dataset -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        FEW,
        {"batch_nb": 3, "batch_size": 41},
        pytest.param(
            {"batch_nb": 1, "batch_size": 1, "mode": "validation"}, marks=pytest.mark.slow
        ),
    ],
)
@pytest.mark.parametrize("clients", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_dataset_of_client_writers_is_that_of_the_server(clients, options):
    wanted = contents(generate("server", "server", num_clients=1, options=options))
    folder = generate("clients", num_clients=clients, options=options)
    assert contents(folder) == wanted
    assert not list((folder / "dataset").glob("dataset.clients"))
    with h5py.File(folder / "dataset" / "clients.h5") as virtual, Dataset.open(folder) as dataset:
        for mode in (mode for mode in COUNTED if mode in dataset):
            for name, view in dataset[mode].items():
                assert virtual[mode][name][:].tobytes() == view[:].tobytes()


@pytest.mark.slow
def test_rows_of_client_writers_can_be_compacted_merged_and_extended(tmp_path):
    folder = generate("clients")
    wanted = contents(folder)
    with Dataset.create(tmp_path / "merged") as merged:
        merged.merge(folder)
    assert contents(tmp_path / "merged") == wanted
    with Dataset.open(folder, writable=True) as dataset:
        dataset.compact()
    assert contents(folder) == wanted
    for writers in ("server", "clients"):
        generate("clients", writers, options={"episodes": 45, "resume": True})
    assert contents(folder) == contents(generate("server", "server", options={"episodes": 45}))


@pytest.mark.slow
def test_commands_take_them():
    command = [sys.executable, "-m", "physx_core"]
    made = ["generate", WALKS, "--environment.num-clients", "2", "--environment.seed", "3"]
    made += ["--episodes", "30", "--dataset.writers", "clients", "--session-name", "a"]
    for words in (made, ["info", "sessions/a"], ["verify", "sessions/a"]):
        done = subprocess.run([*command, *words], capture_output=True, text=True)
        assert not done.returncode, done.stderr
    wanted = contents(generate("b", "server", record_wrong_samples=False))
    assert contents(Path("sessions/a")) == wanted


# Failures ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_episode_of_a_lost_client_writer_is_simulated_again():
    wanted = contents(generate("server", "server"))
    assert contents(generate("clients", env_kwargs={"dies": (12, 1)})) == wanted
    assert Path("died").exists()


@pytest.mark.faults
def test_client_writers_killed_at_random_moments(process_ids):
    options = {"episodes": 300}
    wanted = contents(generate("server", "server", options=options))
    chance, ended = random.Random(seed()), threading.Event()

    def kill():
        while not ended.wait(0.5 + 0.5 * chance.random()):
            alive = list(process_ids().values())
            if alive:
                os.kill(chance.choice(alive), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    threading.Timer(6.0, ended.set).start()
    try:
        folder = generate(
            "clients",
            env_kwargs={"delay": 0.02},
            num_clients=3,
            min_clients=1,
            retries=1000,
            options=options,
        )
    finally:
        ended.set()
        killer.join()
    assert contents(folder) == wanted


def check_killed_runs(run_killed, folder, moments, wanted):
    """Kill a run, with its clients, after each of some times, and let the last one end."""
    folder.mkdir()
    kills, _ = run_killed(str(PROGRAM), folder, moments, "clients", "3", "120")
    assert contents(folder / "sessions" / "run") == wanted
    return kills


def server_dataset(run_killed):
    Path("server").mkdir()
    _, duration = run_killed(str(PROGRAM), Path("server").resolve(), [], "server", "3", "120")
    return contents(Path("server/sessions/run")), duration


@pytest.mark.slow
def test_killed_run_of_client_writers_is_resumed(run_killed):
    wanted, duration = server_dataset(run_killed)
    check_killed_runs(run_killed, Path("killed").resolve(), [0.8 * duration], wanted)


@pytest.mark.faults
def test_runs_of_client_writers_killed_at_random_moments(run_killed):
    (wanted, duration), chance = server_dataset(run_killed), random.Random(seed())
    kills = 0
    for place in range(trials(6, 2)):
        moments = [duration * chance.uniform(0.3, 1.0) for _ in range(3)]
        folder = Path(f"killed-{place}").resolve()
        kills += check_killed_runs(run_killed, folder, moments, wanted)
    assert kills


def test_full_disk_of_client_writers_keeps_committed_rows(small_disk):
    with (
        pytest.raises(DatasetError, match="the disk is full"),
        DataGeneration(
            EnvironmentConfig(f"{PROGRAM}:Large", num_clients=2, seed=3),
            DatasetConfig(writers="clients", max_file_size=2e-4),
            episodes=1000,
            session_dir=str(small_disk),
            session_name="full",
            quiet=True,
        ) as run,
    ):
        run.execute()
    with Dataset.open(small_disk / "full") as dataset:
        known = dataset.recorded_episodes("training")
        assert known.rows.sum() == dataset.num_samples("training") > 50
        first = np.repeat(known.episode, known.rows)
        wanted = first + np.arange(len(first)) % 10 / 100
        np.testing.assert_array_equal(dataset["training"]["x"][:][:, -1], wanted)
        assert dataset.verify() == []


# What does not work -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"as_tcp_ip_client": False, "num_clients": 1}, "as_tcp_ip_client=False starts none"),
        ({"environment": f"{PROGRAM}:Stream"}, "needs independent episodes, but .*Stream"),
        ({"environment": f"{PROGRAM}:Stream"}, "set independent_episodes=True, or episode_steps"),
    ],
)
def test_options_that_do_not_fit_client_writers_are_refused(settings, text):
    with pytest.raises(ConfigError, match=text):
        generate("clients", options={"batch_nb": 2, "batch_size": 5}, **settings)
    assert not Path("sessions/clients").exists()


def test_other_pipelines_refuse_client_writers():
    folder = generate("rows", options={"episodes": 3})
    dataset = DatasetConfig(existing_dir=folder, writers="clients")
    network = NetworkConfig("toy/linear")
    environment = EnvironmentConfig(WALKS)
    with pytest.raises(ConfigError, match="a training needs the rows"):
        Training(network, dataset, epoch_nb=1, batch_size=4).execute()
    with pytest.raises(ConfigError, match="a replay needs the rows"):
        Replay(dataset, environment).execute()
    with pytest.raises(ConfigError, match="unknown|writers"):
        DatasetConfig(writers="everybody")


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, r"(?s)on \S+, must write to .*that the run on \S+ put there"),
        ("something else", "it is not the same folder"),
    ],
)
def test_client_writer_on_other_file_system_is_refused(content, text):
    kwargs = {"content": content} if content else {}
    with pytest.raises(PhysxError, match=text):
        generate("clients", launcher=f"{PROGRAM}:Elsewhere", launcher_kwargs=kwargs)
    assert not Path("sessions/clients").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "message",
    [
        {"kind": "WRITTEN", "number": 10**6},
        {"kind": "ROWS", "number": 1},
        {"kind": "FOLDER", "number": 0},
        {"kind": "SEALED", "number": 0, "value": {"rows": 1}},
        {"kind": "SEALED", "number": 0, "value": 3},
        {"kind": "SEALED", "number": 99, "value": "plausible"},
    ],
)
def test_episodes_of_misbehaving_client_writer_are_simulated_again(message, caplog):
    wanted = contents(generate("server", "server", options={"episodes": 60}))
    folder = generate(
        "clients", environment=f"{PROGRAM}:Rogue", env_kwargs=message, options={"episodes": 60}
    )
    assert contents(folder) == wanted
    assert "was cut off after" in caplog.text


def test_dataset_is_locked_while_clients_write():
    class Meddling(DataGeneration):
        def batch_end(self):
            super().batch_end()
            rows = {name: view[:2] for name, view in self.dataset["training"].items()}
            with pytest.raises(UsageError, match="Other processes write"):
                self.dataset.append("training", rows)
            with pytest.raises(UsageError, match="Other processes write"):
                self.dataset.update("training", 0, {"n": 1})
            with pytest.raises(UsageError, match="Other processes write"):
                self.dataset.remove_partition("training", 0)
            with Dataset.open(self.session.path) as reader:
                count = reader.num_samples("training")
                seen = reader["training"]["episode"][:].tolist()
            assert seen == self.dataset["training"]["episode"][:count].tolist()

    environment = EnvironmentConfig(WALKS, num_clients=2, seed=3)
    dataset = DatasetConfig(writers="clients")
    with Meddling(environment, dataset, batch_nb=2, batch_size=20, quiet=True) as run:
        run.execute()
