"""`physx verify CHECKPOINT`: whether a network's data are what it was trained on."""

import numpy as np
import pytest

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training, View
from physx_core.cli import main

CHECKPOINT = "sessions/training/network/network_0"


@pytest.fixture(autouse=True)
def data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("data", "other"):
        with Dataset.create(name) as dataset:
            x = np.arange(300.0)[:, None]
            number = np.arange(300)
            rows = {"episode": number // 10, "env_id": np.ones(300, int), "step": number % 10}
            dataset.append("training", {"x": x, "y": 2 * x, **rows})


def train(view=None, **options):
    network = NetworkConfig("toy/linear", {"net_fields": ["x"], "opt_fields": ["y"]})
    place = None if view is not None and view.sources else "data"
    config = DatasetConfig(existing_dir=place, view=view or View(fold=0), **options)
    Training(network, config, epoch_nb=3, batch_size=7, seed=0, quiet=True).execute()


def verify(capsys, *words):
    status = main(["verify", CHECKPOINT, *words])
    out, err = capsys.readouterr()
    return status, " ".join((out + err).split())


@pytest.mark.parametrize(
    "view",
    [None, View(hold_back=False), View(weights="episode", fold=1), View(order="blocks", fold=2)],
)
def test_data_as_they_were(capsys, view):
    train(view)
    status, text = verify(capsys, "--read", "--replay")
    assert status == 0
    assert "files: as recorded, 3 epochs" in text
    assert "300 training" in text and "compared with their checksums" in text
    assert "its last: read again, with the same values" in text


def test_each_source_of_a_mixture_is_named(capsys):
    train(View(sources={"data": 0.5, "other": 0.5}, fold=0))
    status, text = verify(capsys, "--read", "--replay")
    assert status == 0 and "read again, with the same values" in text
    assert "data: 300 training of data" in text and "300 training of other" in text
    assert main(["info", "sessions/training"]) == 0
    assert "data in data, other: unchanged since" in capsys.readouterr().out
    with Dataset.open("other", writable=True) as dataset:
        dataset.update("training", np.arange(300), {"x": np.zeros((300, 1))})
    status, text = verify(capsys, "--replay")
    assert status == 1 and "its last, has other values" in text
    assert "training of other: rows were updated" in text
    assert main(["info", "sessions/training"]) == 0
    assert "data, other: training of other: rows were updated" in capsys.readouterr().out


def test_rows_that_were_added_change_nothing(capsys):
    train(shuffle=False)
    with Dataset.open("data", writable=True) as dataset:
        dataset.append("training", {name: dataset["training"][name][:20] for name in
                                    ("x", "y", "episode", "env_id", "step")})  # fmt: skip
    status, text = verify(capsys, "--replay")
    assert status == 0 and "read again, with the same values" in text


@pytest.mark.reported(
    "autoresearch-ai#36",
    "entrenar#119",
    "openmed#1200",
    about="nobody knows which data a checkpoint was trained on",
)
def test_other_values_are_named(capsys):
    train()
    with Dataset.open("data", writable=True) as dataset:
        dataset.update("training", np.arange(300), {"x": np.zeros((300, 1))})
    status, text = verify(capsys, "--replay")
    assert status == 1
    assert "rows were updated" in text and "its last, has other values" in text
    assert "not as they were: 2 differences" in text


def test_removed_data_are_an_error(capsys):
    train()
    with Dataset.open("data", writable=True) as dataset:
        dataset.remove_partition("training", 0)
    status, text = verify(capsys)
    assert status == 1 and "rows were removed" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["data", "--replay"], "--read and --replay are for the folder of a checkpoint"),
        ([CHECKPOINT, "--repair"], "--repair is for a dataset"),
    ],
)
def test_options_of_the_other_kind_are_refused(capsys, words, message):
    train()
    assert main(["verify", *words]) != 0
    assert message in " ".join(capsys.readouterr().err.split())
