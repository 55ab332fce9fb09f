"""DataGeneration whose clients write their rows: those of ``writers="server"``, bit for bit."""

from __future__ import annotations

import json
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
from physx_core.errors import ClientError, ConfigError, DatasetError, NotFiniteError, UsageError
from physx_core.pipelines import Replay

pytestmark = pytest.mark.processes

PROGRAM = Path(__file__).parents[1] / "programs" / "writer_envs.py"
STEPS = f"{PROGRAM}:Steps"


def generate(name, writers="clients", environment=STEPS, *, batches=4, size=25, **options):
    """Generate rows in partitions of few rows; return the session's folder."""
    settings = {"num_clients": 3, "seed": 3, **options}
    extends = settings.pop("extends", False)
    mode = settings.pop("mode", None)
    with DataGeneration(
        EnvironmentConfig(environment, **settings),
        DatasetConfig(writers=writers, max_file_size=settings.pop("file_size", 2e-5)),
        batch_nb=batches,
        batch_size=size,
        session_name=name,
        new_session=not extends,
        mode=mode,
        quiet=True,
    ) as run:
        run.execute()
    return run.session.path


def rows(folder, mode="training"):
    """Return all rows of a dataset by field."""
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        return {name: view[:] for name, view in dataset[mode].items()}


def assert_same(found, wanted):
    assert found.keys() == wanted.keys()
    for name, values in wanted.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def stripes(folder):
    plain = json.loads((folder / "dataset" / "dataset.json").read_text())
    return plain["format_version"], [
        partition.get("stripe") for partition in plain["modes"]["training"]["partitions"]
    ]


# The same rows ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("clients", "batches", "size"), [(1, 3, 40), (3, 4, 41), (4, 30, 1)])
def test_client_writers_store_rows_of_server_writer(clients, batches, size, nothing_stays_behind):
    wanted = rows(generate("server", "server", num_clients=clients, batches=batches, size=size))
    folder = generate("clients", num_clients=clients, batches=batches, size=size)
    assert_same(rows(folder), wanted)
    version, found = stripes(folder)
    if clients == 1:
        assert version == 1 and set(found) == {None}
    else:
        assert version == 2 and [0, clients] in found and [clients - 1, clients] in found
    assert not list((folder / "dataset").glob("dataset.clients"))


def test_client_written_rows_are_read_by_every_reader(nothing_stays_behind, tmp_path):
    plain = generate("server", "server", size=30)
    folder = generate("clients", size=30)
    wanted = rows(plain)
    with Dataset.open(folder) as dataset, Dataset.open(plain) as other:
        for strategy in ("memory", "disk exact", "disk windowed"):
            options = {"shuffle": True, "seed": 1, "strategy": strategy}
            pairs = zip(
                dataset.batches("training", 7, **options),
                other.batches("training", 7, **options),
                strict=True,
            )
            for batch, expected in pairs:
                assert_same(batch, expected)
        index = np.random.default_rng(0).permutation(120)[:50]
        np.testing.assert_array_equal(dataset["training"]["x"][index], wanted["x"][index])
        np.testing.assert_array_equal(dataset["training"]["x"][17:90:4], wanted["x"][17:90:4])
        found, expected = dataset.episodes("training"), other.episodes("training")
        assert [list(one.rows) for one in found] == [list(one.rows) for one in expected]
        parts = [d.split("training", {"a": 0.5}, by="episode") for d in (dataset, other)]
        assert list(parts[0]["a"].rows) == list(parts[1]["a"].rows)
        mean, expected = dataset.normalization["x"], other.normalization["x"]
        np.testing.assert_allclose(mean.mean, expected.mean, atol=1e-12)
        np.testing.assert_allclose(mean.std, expected.std, rtol=1e-12)
    with h5py.File(folder / "dataset" / "clients.h5") as virtual:
        for name, values in wanted.items():
            np.testing.assert_array_equal(virtual["training"][name][:], values)
    with Dataset.create(tmp_path / "merged") as merged:
        with Dataset.open(folder) as dataset:
            merged.define_fields("training", dataset.fields("training").values())
        merged.append("training", {name: values[:5] for name, values in wanted.items()})
        merged.merge(folder)
        merged.update("training", slice(40, 60), {"x": np.zeros((20, 30))})
    joined = {name: np.concatenate([values[:5], values]) for name, values in wanted.items()}
    joined["x"][40:60] = 0
    assert_same(rows(tmp_path / "merged"), joined)
    Dataset.rebuild(tmp_path / "merged")
    assert_same(rows(tmp_path / "merged"), joined)


def test_commands_take_them(nothing_stays_behind, tmp_path):
    command = [sys.executable, "-m", "physx_core"]
    words = ["generate", STEPS, "--environment.num-clients", "2", "--environment.seed", "1"]
    words += ["--batch-nb", "3", "--batch-size", "20", "--dataset.writers", "clients"]
    made = subprocess.run([*command, *words, "--session-name", "a"], capture_output=True, text=True)
    assert not made.returncode, made.stderr
    wanted = rows(generate("b", "server", num_clients=2, seed=1, batches=3, size=20))
    assert_same(rows(Path("sessions/a")), wanted)
    for words in (["info", "sessions/a"], ["verify", "sessions/a"]):
        done = subprocess.run([*command, *words], capture_output=True, text=True)
        assert not done.returncode, done.stderr
    done = subprocess.run(
        [*command, "export", "sessions/a", "out", "--to", "npz"], capture_output=True, text=True
    )
    assert not done.returncode, done.stderr


@pytest.mark.faults
def test_client_writers_extend_sessions(nothing_stays_behind):
    turns = [("clients", 3, 20), ("server", 2, 15), ("clients", 2, 25), ("clients", 4, 3)]
    for name in ("one", "two"):
        for place, (writers, clients, size) in enumerate(turns):
            generate(
                name,
                writers if name == "one" else "server",
                num_clients=clients,
                size=size,
                extends=place > 0,
            )
    assert_same(rows(Path("sessions/one")), rows(Path("sessions/two")))
    generate("one", mode="validation", extends=True)
    generate("two", "server", mode="validation", extends=True)
    for mode in ("training", "validation"):
        assert_same(rows(Path("sessions/one"), mode), rows(Path("sessions/two"), mode))


# Failures ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "step",
    [pytest.param(0, marks=pytest.mark.faults), 3, pytest.param(29, marks=pytest.mark.faults)],
)
def test_restarted_client_writer_continues_its_partitions(step, nothing_stays_behind):
    wanted = rows(generate("server", "server", size=40))
    arguments = {"dies": (2, step)}
    folder = generate("clients", size=40, env_kwargs=arguments, restarts=1)
    assert Path("died").exists()
    assert_same(rows(folder), wanted)


@pytest.mark.faults
def test_client_writers_killed_at_random_moments(nothing_stays_behind, process_ids):
    wanted = rows(generate("server", "server", batches=30))
    chance, ended = random.Random(seed()), threading.Event()

    def kill():
        while not ended.wait(0.2 + 0.3 * chance.random()):
            alive = list(process_ids().values())
            if alive:
                os.kill(chance.choice(alive), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    threading.Timer(6.0, ended.set).start()
    try:
        folder = generate("clients", batches=30, env_kwargs={"delay": 0.02}, restarts=1000)
    finally:
        ended.set()
        killer.join()
    assert_same(rows(folder), wanted)


def test_full_disk_of_client_writers_keeps_committed_rows(small_disk, nothing_stays_behind):
    with (
        pytest.raises(DatasetError, match="the disk is full"),
        DataGeneration(
            EnvironmentConfig(f"{PROGRAM}:Large", num_clients=2, seed=3),
            DatasetConfig(writers="clients", max_file_size=1e-3),
            batch_nb=1000,
            batch_size=10,
            session_dir=str(small_disk),
            session_name="full",
            quiet=True,
        ) as run,
    ):
        run.execute()
    with Dataset.open(small_disk / "full") as dataset:
        count = dataset.num_samples("training")
        assert count > 50
        row = np.arange(count)
        wanted = row // 2 + (row % 2 + 1) / 10
        np.testing.assert_array_equal(dataset["training"]["x"][:][:, -1], wanted)
        assert dataset.verify() == []


def test_rows_before_error_of_client_writer_stay(nothing_stays_behind):
    wanted = rows(generate("server", "server", batches=3, size=60))
    with pytest.raises(NotFiniteError, match='field "x"'):
        generate("clients", environment=f"{PROGRAM}:Gaps", batches=30)
    found = rows(Path("sessions/clients"))
    count = len(found["n"])
    assert 25 <= count < 100
    assert_same(found, {name: values[:count] for name, values in wanted.items()})
    with pytest.raises(ClientError):
        generate("died", env_kwargs={"dies": (3, 20)})
    found = rows(Path("sessions/died"))
    count = len(found["n"])
    assert_same(found, {name: values[:count] for name, values in wanted.items()})


def check_killed_run(run_killed, folder, moment, wanted):
    """Kill a run, with its clients, and run it again; return how many rows the first one left."""
    folder.mkdir()
    kills, _ = run_killed(str(PROGRAM), folder, [moment], "clients", "3", "12", "30")
    found = rows(folder / "sessions" / "run")
    left = len(found["n"]) - 12 * 30
    assert_same(
        {name: values[:left] for name, values in found.items()},
        {name: values[:left] for name, values in wanted.items()},
    )
    turns = np.arange(12 * 30) % 3 + 1  # the second run begins with the first instance
    np.testing.assert_array_equal(found["env_id"][left:], turns)
    assert kills or not left
    return left


def server_rows(run_killed):
    Path("server").mkdir()
    _, duration = run_killed(str(PROGRAM), Path("server").resolve(), [], "server", "3", "12", "30")
    return rows(Path("server/sessions/run")), duration


def test_killed_run_of_client_writers_leaves_no_gap(run_killed, nothing_stays_behind):
    wanted, duration = server_rows(run_killed)
    assert check_killed_run(run_killed, Path("killed").resolve(), 0.8 * duration, wanted) >= 0


@pytest.mark.faults
def test_runs_of_client_writers_killed_at_random_moments(run_killed, nothing_stays_behind):
    (wanted, duration), chance = server_rows(run_killed), random.Random(seed())
    shares = [0.9, *(chance.uniform(0.3, 1.0) for _ in range(trials(4, 2)))]
    left = [
        check_killed_run(run_killed, Path(f"killed-{place}").resolve(), duration * share, wanted)
        for place, share in enumerate(shares)
    ]
    assert max(left) > 0


# What does not work -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"as_tcp_ip_client": False, "num_clients": 1}, "as_tcp_ip_client=False starts none"),
        ({"record_wrong_samples": True}, "leave out record_wrong_samples"),
        ({"environment": f"{PROGRAM}:Drawn"}, "has parameters"),
    ],
)
def test_options_that_need_rows_are_refused_with_client_writers(
    options, text, nothing_stays_behind
):
    with pytest.raises(ConfigError, match=text):
        generate("clients", **options)
    assert not Path("sessions/clients").exists()


def test_other_pipelines_refuse_client_writers(nothing_stays_behind):
    folder = generate("rows")
    dataset = DatasetConfig(existing_dir=folder, writers="clients")
    network = NetworkConfig("toy/linear")
    environment = EnvironmentConfig(STEPS)
    with pytest.raises(ConfigError, match="a training needs the rows"):
        Training(network, dataset, epoch_nb=1, batch_size=4).execute()
    with pytest.raises(ConfigError, match="a replay needs the rows"):
        Replay(dataset, environment).execute()
    with pytest.raises(ConfigError, match="unknown|writers"):
        DatasetConfig(writers="everybody")


@pytest.mark.parametrize(
    ("content", "error", "text"),
    [
        (None, DatasetError, r"(?s)on \S+, must write to .*that the run on \S+ put there"),
        ("something else", ClientError, "it is not the same folder"),
    ],
)
def test_client_writer_on_other_file_system_is_refused(content, error, text, nothing_stays_behind):
    with pytest.raises(error, match=text):
        generate(
            "clients",
            launcher=f"{PROGRAM}:Elsewhere",
            launcher_kwargs={"content": content} if content else {},
        )
    assert not Path("sessions/clients").exists()


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ({"kind": "WRITTEN", "number": 10**6}, "rows that nobody asked for"),
        ({"kind": "WRITTEN", "number": 0}, "rows that nobody asked for"),
        ({"kind": "ROWS", "number": 1}, "sent ROWS, which a client may not send"),
        ({"kind": "FOLDER", "number": 0}, "it is not the same folder"),
        ({"kind": "SEALED", "number": 0, "value": {"rows": 1}}, "impossible numbers"),
        ({"kind": "SEALED", "number": 0, "value": {"checksums": 3}}, "impossible numbers"),
        ({"kind": "SEALED", "number": 99, "value": "x"}, "impossible numbers"),
        ({"kind": "SEALED", "number": 0, "value": "plausible"}, "did not seal its partition 0"),
        ({"kind": "SEALED", "number": 99, "value": "plausible"}, "did not seal its partition 99"),
    ],
)
def test_protocol_violation_disconnects_client_writer(message, text, nothing_stays_behind):
    with pytest.raises(ClientError, match=text):
        generate("clients", environment=f"{PROGRAM}:Rogue", batches=20, env_kwargs=message)
    if Path("sessions/clients").exists():  # it is removed if no row was complete by then
        with Dataset.open("sessions/clients") as dataset:
            assert dataset.verify() == []


def test_dataset_is_locked_while_clients_write(nothing_stays_behind):
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
            assert self.dataset.num_samples("training") == 25 * self.batch_id
            assert not self.batch

    config = EnvironmentConfig(STEPS, num_clients=2, seed=3)
    dataset = DatasetConfig(writers="clients")
    with Meddling(config, dataset, batch_nb=3, batch_size=25, quiet=True) as run:
        run.execute()
    wanted = rows(generate("server", "server", num_clients=2, batches=3))
    assert_same(rows(run.session.path), wanted)
