"""What a resumed training takes from its session, and the data that it was trained on."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

from physx_core import Dataset, DatasetConfig, EnvironmentConfig, NetworkConfig, Training, View
from physx_core.cli import main
from physx_core.config import read_toml
from physx_core.errors import ConfigError
from physx_core.toy import Linear

SESSION = Path("sessions/training")


@pytest.fixture(autouse=True)
def data(tmp_path):
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        for mode, rows in (("training", 40), ("validation", 10)):
            x = rng.normal(size=(rows, 2))
            dataset.append(mode, {"state": x, "next_state": x @ [[1.0, 0.5], [0.0, 2.0]]})


def train(epoch_nb=1, *, resume=True, network=None, dataset=None, **options):
    options = {"batch_size": 10, "seed": 3, "quiet": True, "resume": resume} | options
    config = DatasetConfig(**{"existing_dir": "data", **(dataset or {})})
    network = NetworkConfig(**{"network": "toy/linear", **(network or {})})
    training = Training(network, config, epoch_nb=epoch_nb, **options)
    training.execute()
    return training


BOUND = [
    ({"batch_size": 20}, "batch_size was 10 and is now 20"),
    ({"batch_nb": 2}, "batch_nb was None and is now 2"),
    ({"seed": 4}, "seed was 3 and is now 4"),
    ({"network": {"lr": 0.1}}, "network.lr was None and is now 0.1"),
    ({"network": {"optimizer": "Adam"}}, "network.optimizer was None and is now 'Adam'"),
    ({"network": {"data_type": "float64"}}, "data_type was 'float32' and is now 'float64'"),
    ({"network": {"network_dir": "elsewhere"}}, "network.network_dir was None"),
    ({"network": {"network_kwargs": {"net_fields": ["next_state"]}}}, "network.network_kwargs"),
    ({"dataset": {"normalize": True}}, "dataset.normalize was False and is now True"),
    ({"dataset": {"shuffle": False}}, "dataset.shuffle was True and is now False"),
    ({"dataset": {"view": View(fold=1)}}, "dataset.view.fold was 0 and is now 1"),
    ({"online": "physx/reservoir"}, "online was 'physx/stream' and is now 'physx/reservoir'"),
]


@pytest.mark.parametrize(("options", "message"), BOUND)
def test_resume_with_changed_option_is_refused(options, message):
    train(resume=False)
    before = (SESSION / "config.toml").read_bytes()
    with pytest.raises(ConfigError, match=r"network_dir='sessions.training'") as error:
        train(2, **options)
    assert message in str(error.value)
    assert (SESSION / "config.toml").read_bytes() == before
    train(2)


def test_all_options_that_differ_are_named(capsys):
    train(resume=False)
    words = ["train", str(SESSION), "--resume", "--epoch-nb", "2"]
    asked = ["--network.lr", "1e-5", "--batch-size", "4", "--dataset.normalize"]
    assert main([*words, *asked]) == 1
    text = capsys.readouterr().err
    for name in ("network.lr was None", "batch_size was 10", "dataset.normalize was False"):
        assert name in text
    assert "--network.network-dir sessions/training" in text
    assert main(words) == 0


def test_a_resume_honors_options_that_the_training_does_not_depend_on():
    train(resume=False)
    shutil.move("data", "moved")
    options = {"patience": 5, "checkpoint_every": 1, "validation_every": 2, "on_nan": "continue"}
    network = {"save_each_epoch": True, "save_best": True}
    again = train(3, network=network, dataset={"existing_dir": "moved"}, **options)
    assert again.epoch_id == 3
    plain = read_toml(SESSION / "config.toml")["training"]
    assert {name: plain[name] for name in options} == options
    assert plain["dataset"]["existing_dir"] == "moved" and plain["epoch_nb"] == 3
    assert plain["network"]["save_each_epoch"] and plain["seed"] == 3


def test_a_seed_that_is_not_given_and_a_class_instead_of_its_name_are_the_same():
    train(resume=False)
    train(2, seed=None)
    assert read_toml(SESSION / "config.toml")["training"]["seed"] == 3
    train(resume=False, network={"network": Linear}, session_name="own")
    train(2, network={"network": "physx_core.toy:Linear"}, session_name="own")


def test_another_environment_is_refused_although_it_has_nothing_left_to_generate():
    def online(epoch_nb, mass, resume):
        environment = EnvironmentConfig("toy/spring", {"mass": mass}, as_tcp_ip_client=False)
        Training(
            NetworkConfig("toy/linear"), None, environment, epoch_nb=epoch_nb, batch_size=5,
            batch_nb=2, seed=1, quiet=True, resume=resume,
        ).execute()  # fmt: skip

    online(1, 1.0, False)
    with pytest.raises(ConfigError, match=r"environment\.env_kwargs was \{'mass': 1\.0\}"):
        online(2, 2.0, True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        online(2, 1.0, True)


CHANGES = [
    (lambda d: d.update("training", 7, {"state": [9.0, 9.0]}), ["training: rows were updated"]),
    (
        lambda d: (d.append("training", rows(1)), d.update("training", 7, {"state": [9.0, 9.0]})),
        ["training: rows were updated"],
    ),
    (lambda d: d.remove_partition("validation", 0), ["validation: rows were removed"]),
]


def rows(count):
    return {"state": np.ones((count, 2)), "next_state": np.ones((count, 2))}


@pytest.mark.parametrize(("change", "messages"), CHANGES)
def test_resume_with_changed_data_is_refused(change, messages, capsys):
    train(resume=False)
    with Dataset.open("data", writable=True) as dataset:
        change(dataset)
    assert main(["info", str(SESSION)]) == 0
    told = capsys.readouterr().out
    with pytest.warns(UserWarning, match="changed since the checkpoint") as caught:
        train(2)
    note = (SESSION / "info.txt").read_text()
    for message in messages:
        assert message in told and message in str(caught[0].message)
        assert message in " ".join(note.split())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(3)


def test_a_resumed_training_does_not_read_rows_that_were_appended(capsys):
    train(resume=False, session_name="whole")
    whole = train(3, session_name="whole")
    train(resume=False)
    with Dataset.open("data", writable=True) as dataset:
        dataset.append("training", rows(5))
        dataset.append("validation", rows(3))
    assert main(["info", str(SESSION)]) == 0
    told = capsys.readouterr().out
    assert "training: 5 rows were appended to 40" in told
    assert "validation: 3 rows were appended to 10" in told
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        resumed = train(3)
    assert resumed.training_loss == whole.training_loss
    assert resumed.validation_loss == whole.validation_loss


def test_info_names_the_data_that_each_network_was_trained_on(capsys):
    train(resume=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(2)
    assert main(["info", str(SESSION)]) == 0
    told = capsys.readouterr().out
    assert told.count("trained on 40 training (") == told.count("unchanged since") >= 2
    with Dataset.open("data", writable=True) as dataset:
        dataset.append("training", rows(5))
    train(3)
    assert main(["info", str(SESSION)]) == 0
    told = capsys.readouterr().out
    assert "trained on 45 training (" in told and "trained on 40 training (" in told
    shutil.rmtree("data")
    assert main(["info", str(SESSION)]) == 0
    assert "is not known: There is no dataset" in capsys.readouterr().out
