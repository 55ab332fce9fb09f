"""Predictions: several instances, in process and over TCP, replays, recording, the end."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Observer,
    Prediction,
    Replay,
    Training,
    plugins,
)
from physx_core.cli import main
from physx_core.errors import (
    ConfigError,
    DatasetError,
    DatasetNotFoundError,
    PluginError,
    WrongSamplesError,
)

pytestmark = pytest.mark.processes

ENVS = Path(__file__).parents[1] / "programs" / "source_envs.py"
NETWORK = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "y"})


def environment(name="Doubling", **options):
    kwargs = {key: options.pop(key) for key in ("factor", "refuse") if key in options}
    options = {"as_tcp_ip_client": False, "seed": 4, **options}
    return EnvironmentConfig(f"{ENVS}:{name}", env_kwargs=kwargs, **options)


@pytest.fixture(autouse=True)
def trained():
    """A session with a dataset of 11 samples, and one with a network that gives twice the sum."""
    DataGeneration(environment(factor=2.0), session_name="run", batch_nb=1, batch_size=11).execute()
    before = content("sessions/run/dataset")
    Training(
        NETWORK, DatasetConfig(existing_dir="sessions/run"), epoch_nb=1, batch_size=11
    ).execute()
    yield
    assert content("sessions/run/dataset") == before  # nothing that reads it changes it


def content(folder):
    paths = sorted(Path(folder).iterdir())
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}


def predict(config, existing=None, **options):
    data = None if existing is None else DatasetConfig(existing_dir=existing)
    options = {"step_nb": 5, "record": True, **options}
    prediction = Prediction(NetworkConfig(), config, data, **options)
    prediction.execute()
    return prediction


def take(mode="prediction", session="training"):
    """Return the rows that were recorded, and forget them."""
    with Dataset.open(f"sessions/{session}", writable=True) as dataset:
        assert dataset.verify() == []
        rows = {name: view[:] for name, view in dataset[mode].items()}
        names = [path.stem for path in dataset.directory.glob(f"*_{mode}_*.h5")]
        for number in {int(name.rpartition("_")[2]) for name in names}:
            dataset.remove_partition(mode, number)
    return rows


def same(a, b):
    assert list(a) == list(b)
    for name in a:
        assert a[name].dtype == b[name].dtype
        assert a[name].tobytes() == b[name].tobytes(), name


# Several instances ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Doubling", "Applying", "Asking"])
def test_clients_give_the_numbers_of_instances_in_process(name, nothing_stays_behind):
    runs = []
    for over_tcp in (False, True):
        config = environment(name, num_clients=3, as_tcp_ip_client=over_tcp)
        predict(config)
        runs.append(take())
    rows = runs[0]
    assert rows["env_id"].tolist() == [1, 2, 3] * 5
    assert rows["step"].tolist() == [step for step in range(5) for _ in range(3)]
    if name == "Asking":  # the network answers one by one in process, and all clients at once
        answers = [run.pop("answer") for run in runs]
        assert np.allclose(*answers, rtol=1e-12)
    same(*runs)
    assert np.allclose(rows["predicted_y"][:, 0], 2 * rows["x"].sum(axis=1))
    if name == "Applying":  # each gets its own row, one step late
        assert np.array_equal(rows["seen"][3:, 0], (1e6 * rows["predicted_y"][:-3, 0]).astype(int))


def test_several_run_in_clients_and_one_in_this_process(nothing_stays_behind):
    from physx_core.sources import ClientSource, LocalSource

    for number, over_tcp, expected in (
        (1, True, LocalSource),
        (2, True, ClientSource),
        (2, False, LocalSource),
    ):
        config = environment(num_clients=number, as_tcp_ip_client=over_tcp)
        with Prediction(NetworkConfig(), config, step_nb=1) as prediction:
            assert type(prediction.source) is expected


def test_rejected_samples_are_recorded_with_the_others(nothing_stays_behind):
    runs = []
    for over_tcp in (False, True):
        config = environment(
            refuse=3, num_clients=2, as_tcp_ip_client=over_tcp, record_wrong_samples=True
        )
        predict(config, step_nb=6)
        runs.append((take(), take("wrong")))
    same(runs[0][0], runs[1][0])
    same(runs[0][1], runs[1][1])
    assert runs[0][1]["step"].tolist() == [1, 1, 4, 4, 7, 7]
    predict(environment(refuse=3, record_wrong_samples=True), record=False)
    with Dataset.open("sessions/training") as dataset:
        assert not dataset.num_samples("wrong")
    with pytest.raises(WrongSamplesError):
        predict(environment(refuse=2, max_wrong_samples_per_step=0, record_wrong_samples=True))
    assert take()["step"].tolist() == [0] and take("wrong")["step"].tolist() == [1]


# Stored samples ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("instances", "over_tcp"), [(1, False), (3, False), (3, True)])
def test_stored_samples_are_replayed_in_order_and_start_over(
    instances, over_tcp, nothing_stays_behind
):
    config = environment(
        factor=5.0, num_clients=instances, as_tcp_ip_client=over_tcp, load_samples=True
    )
    steps = 28 // instances
    predict(config, "sessions/run", step_nb=steps)
    rows = take()
    with Dataset.open("sessions/run") as dataset:
        stored = dataset["training"]["x"][:]
    order = np.arange(steps * instances) % 11
    assert np.array_equal(rows["x"], stored[order])
    assert rows["seen"][:, 2].tolist() == order.tolist()
    assert np.allclose(rows["y"][:, 0], 5 * rows["x"].sum(axis=1))
    assert np.allclose(rows["predicted_y"][:, 0], 2 * rows["x"].sum(axis=1))


def test_more_instances_than_samples_go_round():
    config = environment(num_clients=25, load_samples=True)
    predict(config, "sessions/run", step_nb=2)
    assert take()["seen"][:, 2].tolist() == (np.arange(50) % 11).tolist()


def test_the_sessions_own_samples_are_replayed_where_no_others_are_named():
    Training(
        NETWORK, DatasetConfig(existing_dir="sessions/run"), environment(load_samples=True),
        epoch_nb=1, batch_size=11, session_name="own",
    ).execute()  # fmt: skip
    with Dataset.open("sessions/own") as dataset:
        before = {name: view[:] for name, view in dataset["training"].items()}
    predict(environment(load_samples=True), session_name="own", step_nb=15)
    with Dataset.open("sessions/own") as dataset:
        same({name: view[:] for name, view in dataset["training"].items()}, before)
        assert dataset.num_samples("prediction") == 15
    recorded = DatasetConfig(mode="prediction")  # what is recorded meanwhile is not replayed
    Prediction(
        NetworkConfig(), environment(load_samples=True), recorded, session_name="own",
        step_nb=20, record=True,
    ).execute()  # fmt: skip
    rows = take(session="own")
    assert rows["seen"][15:, 2].tolist() == [*range(15), *range(5)]


def test_samples_that_are_not_there_are_named():
    with pytest.raises(DatasetNotFoundError):
        predict(environment(load_samples=True))
    with pytest.raises(DatasetError, match='no samples of mode "validation" to send'):
        Prediction(
            NetworkConfig(), environment(load_samples=True),
            DatasetConfig(existing_dir="sessions/run", mode="validation"), step_nb=1,
        ).execute()  # fmt: skip


def test_the_command_replays_too(capsys):
    words = ["predict", "sessions/training", f"{ENVS}:Doubling", "--environment.load-samples"]
    words += ["--dataset.existing-dir", "sessions/run", "--step-nb", "13", "--record"]
    assert main([*words, "--environment.env-kwargs", "factor=5.0"]) == 0
    assert "13 steps" in capsys.readouterr().err
    assert take()["seen"][:, 2].tolist() == [*range(11), 0, 1]


# The end ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("steps", [-1, 1_000_000])
def test_ctrl_c_ends_prediction_cleanly(tmp_path, steps, nothing_stays_behind):
    script = tmp_path / "script.py"
    script.write_text(
        "from physx_core import *\n"
        "if __name__ == '__main__':\n"
        f"    environment = EnvironmentConfig({f'{ENVS}:Keeping'!r}, num_clients=2, seed=0)\n"
        f"    Prediction(NetworkConfig(), environment, step_nb={steps}, record=True).execute()\n"
        "    print('in order')\n"
    )
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    folder, deadline = Path("sessions/training/dataset"), time.monotonic() + 60
    while not list(folder.glob("*_prediction_step_*.h5")) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode == 0) == ("in order" in out) == (steps < 0), err
    assert ("KeyboardInterrupt" in err) == (steps >= 0)
    rows = take()
    count = len(rows["step"])
    assert count and count % 2 == 0 and rows["env_id"].tolist() == [1, 2] * (count // 2)
    assert list(folder.glob("parameters_*.bin"))  # they were closed


# Replay -----------------------------------------------------------------------------------------


class Watch(Observer):
    """Writes down in the session what is drawn."""

    def open(self, run_name, session_dir, instance_nb):
        self.file = session_dir / "drawn.txt"

    def events(self, instance_id, step, events):
        with self.file.open("a") as stream:
            names = " ".join(name for event in events for name in event.names)
            stream.write(f"{instance_id} {step} {names}\n")


def test_replay_sends_each_sample_once_through_the_environment_that_made_it():
    seen = []

    class Mine(Replay):
        def sample_end(self):
            seen.extend(self.batch["seen"][:, 2].tolist())

    data = DatasetConfig(existing_dir="sessions/run")
    Mine(data, trust=True).execute()
    assert seen == list(range(11))
    del seen[:]
    several = environment(num_clients=4)
    Mine(data, several, step_nb=None).execute()
    Mine(data, several, step_nb=1).execute()
    assert seen == [*range(11), 0, *range(4)]
    assert sorted(path.name for path in Path("sessions").iterdir()) == [
        "replay", "replay_1", "replay_2", "run", "training",
    ]  # fmt: skip


def test_the_command_replays_what_a_session_holds_and_draws_it():
    DataGeneration(
        EnvironmentConfig("toy/spring", as_tcp_ip_client=False, num_clients=2),
        session_name="springs", batch_nb=1, batch_size=6,
    ).execute()  # fmt: skip
    words, viewer = (
        ["replay", "sessions/springs"],
        ["--environment.visualizer", f"{__file__}:Watch"],
    )
    assert main([*words, *viewer]) == 0
    drawn = Path("sessions/replay/drawn.txt").read_text().splitlines()
    assert sorted(line for line in drawn if "view" not in line)[-6:] == [
        f"{number} {step} mass spring time" for number in (1, 2) for step in range(3)
    ]
    assert main([*words, "toy/spring", *viewer, "--environment.num-clients", "1"]) == 0
    assert "num_clients = 1" in Path("sessions/replay_1/config.toml").read_text()


@pytest.mark.parametrize("over_tcp", [False, True])
def test_rejected_samples_are_replayed_once_each(over_tcp, nothing_stays_behind):
    config = environment("Refusing", record_wrong_samples=True, num_clients=2)
    DataGeneration(config, session_name="refused", batch_nb=1, batch_size=14).execute()
    with Dataset.open("sessions/refused") as dataset:
        wrong = {name: view[:] for name, view in dataset["wrong"].items()}
    seen = []

    class Mine(Replay):
        def sample_end(self):
            seen.extend(zip(self.batch["seen"][:, 0], self.batch["seen"][:, 2], strict=True))

    again = environment("Refusing", num_clients=2, as_tcp_ip_client=over_tcp)
    data = DatasetConfig(existing_dir="sessions/refused", mode="wrong")
    Mine(data, again, session_name="replay").execute()
    assert seen == list(zip(wrong["env_id"], wrong["step"], strict=True)) and len(seen) == 12
    with pytest.raises(ConfigError, match='"wrong" is for samples that check_sample rejects'):
        DataGeneration(config, DatasetConfig(mode="wrong"), batch_nb=1, batch_size=1).execute()
    with pytest.raises(ConfigError, match="To view them: physx replay"):
        Training(NETWORK, DatasetConfig(mode="wrong"), config, epoch_nb=1, batch_size=1).execute()


def test_the_command_replays_the_rejected_samples(capsys):
    config = environment("Refusing", record_wrong_samples=True)
    DataGeneration(config, session_name="refused", batch_nb=1, batch_size=4).execute()
    words = ["sessions/refused", "--environment.no-as-tcp-ip-client"]
    words += ["--environment.visualizer", f"{__file__}:Watch", "--trust"]
    assert main(["replay", *words, "--mode", "wrong"]) == 0
    assert "3 steps of" in capsys.readouterr().err
    assert main(["replay", *words, "--mode", "validation"]) == 1
    assert 'no samples of mode "validation"' in capsys.readouterr().err


@pytest.mark.parametrize("installed", [[], ["watch"], ["watch", "other"]])
def test_the_command_takes_the_only_visualizer_plugin(installed, monkeypatch, capsys):
    own = plugins.load

    def load(name):
        if name == "physx":
            return own(name)
        kinds = {"visualizer": {name: Watch}}
        if name == "more":
            kinds["network"] = {}
        if name == "broken":
            raise PluginError(name, "broken")
        return plugins.Plugin(plugins.PluginInfo(name, (), ""), kinds)

    DataGeneration(environment(), session_name="few", batch_nb=1, batch_size=2).execute()
    found = dict.fromkeys([*installed, "more", "broken"])
    for module in ("physx_core.plugins", "physx_core.plugins.references"):
        monkeypatch.setattr(f"{module}.available", lambda: found)
        monkeypatch.setattr(f"{module}.load", load)
    words = ["replay", "sessions/few", "--environment.no-as-tcp-ip-client", "--trust"]
    assert main(words) == (len(installed) != 1)
    if len(installed) == 1:
        assert Path("sessions/replay/drawn.txt").exists()
    else:
        text = capsys.readouterr().err
        assert "physx replay needs --environment.visualizer" in text
        assert f"Installed: {', '.join(sorted(installed)) or 'none'}" in text
        assert not Path("sessions/replay").exists()
    assert main([*words, "--environment.visualizer", "None"]) == 0


def test_replay_needs_to_know_samples_and_environment():
    with pytest.raises(ConfigError, match="name their dataset in existing_dir"):
        Replay(DatasetConfig()).execute()
    with Dataset.create("bare") as dataset:
        dataset.append("training", {"x": np.zeros((3, 2))})
    with pytest.raises(ConfigError, match="does not name its environment"):
        Replay(DatasetConfig(existing_dir="bare")).execute()
    assert not Path("sessions/replay").exists()
