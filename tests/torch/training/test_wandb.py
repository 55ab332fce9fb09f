"""What is written for Weights & Biases offline, read back from the file that it would send."""

import json
import struct
import sys
import time

import numpy as np
import psutil
import pytest

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training
from physx_core.errors import ConfigError, MissingLibraryError
from physx_torch import WandB

pytestmark = pytest.mark.processes

records = pytest.importorskip("wandb.proto.wandb_internal_pb2")
BLOCK, HEADER, MAGIC = 2**15, 7, 7
FULL, FIRST, MIDDLE, LAST = 1, 2, 3, 4


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def read(session):
    """Return the history of the only run: a dictionary for each call of ``log``.

    W&B's service writes the end of a file after the run has finished.
    """
    (path,) = session.glob("stats/wandb/offline-run-*/run-*.wandb")
    until, found = time.monotonic() + 20, []
    while not any(record.HasField("exit") for record in found):
        assert time.monotonic() < until, f"the run has no end after {len(found)} records"
        time.sleep(0.01)
        found = list(parse(path.read_bytes()))
    return [
        {item.key or ".".join(item.nested_key): json.loads(item.value_json) for item in one}
        for one in (record.history.item for record in found)
        if one
    ]


def parse(content):
    """Yield the records of a log in the format of LevelDB, in blocks of 32 KiB."""
    place, parts = MAGIC, []
    while place + HEADER <= len(content):  # the last record may be incomplete
        if BLOCK - place % BLOCK < HEADER:
            place += BLOCK - place % BLOCK
            continue
        _, length, kind = struct.unpack_from("<IHB", content, place)
        if place + HEADER + length > len(content):
            return
        parts.append(content[place + HEADER : place + HEADER + length])
        place += HEADER + length
        if kind in (FULL, LAST):
            record = records.Record()
            record.ParseFromString(b"".join(parts))
            parts = []
            yield record


@pytest.fixture
def observer(tmp_path):
    """An open observer that leaves nothing out."""
    observer = WandB(interval=0)
    observer.open("run", tmp_path, 1)
    yield observer
    observer.close()


@pytest.mark.slow
def test_numbers_and_histograms(observer, folder):
    for step in (1, 2):
        observer.scalars({"loss/batch": step / 2}, step, "batch")
    observer.scalars({"loss/training": 0.25}, 1, "epoch")
    values = np.array([1.0, 2.0, np.nan])
    observer.histograms({"weights/a": values, "weights/b": values[2:]}, 1, "epoch")
    observer.note("stopped early")
    observer.close()
    found = [{k: v for k, v in row.items() if not k.startswith("_")} for row in read(folder)]
    assert found[:2] == [{"loss/batch": 0.5, "batch": 1}, {"loss/batch": 1.0, "batch": 2}]
    assert found[2] == {"loss/training": 0.25, "epoch": 1}
    assert found[3]["epoch"] == 1 and sum(found[3]["weights/a.values"]) == 2
    assert not any(name.startswith("weights/b") for name in found[3])
    (line,) = observer.outputs()
    assert line.startswith(f"curves: {folder}/stats/wandb/offline-run-") and "wandb sync" in line


def test_of_many_batches_some_are_written_and_the_last_one(folder):
    observer = WandB(interval=1000)
    observer.open("run", folder, 1)
    for step in range(1, 50):
        observer.scalars({"loss/batch": step}, step, "batch")
    observer.close()
    assert [row["batch"] for row in read(folder)] == [1, 49]


def test_nothing_stays_behind(folder):
    before = set(psutil.Process().children(recursive=True))
    observer = WandB()
    observer.open("run", folder, 1)
    observer.close()
    left = set(psutil.Process().children(recursive=True)) - before
    # W&B's service belongs to the process, for its next runs; it ends with it.
    assert all("wandb" in " ".join(process.cmdline()) for process in left)


def test_before_and_after_a_run_nothing_is_written(folder):
    observer = WandB()
    observer.scalars({"x": 1.0}, 1, "batch")
    observer.histograms({"x": np.ones(3)}, 1, "epoch")
    observer.note("text")
    observer.close()
    assert not list(folder.iterdir()) and observer.outputs() == []


@pytest.mark.parametrize("options", [{"mode": "somewhere"}, {"interval": -1}])
def test_options_are_checked(options):
    with pytest.raises(ConfigError, match="offline|not be negative"):
        WandB(**options)


def test_a_missing_library_is_named_with_the_line_that_installs_it(monkeypatch, folder):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(MissingLibraryError, match=r'pip install .*physx.torch\[wandb\]"'):
        WandB().open("run", folder, 0)


def test_a_training_sends_what_its_own_file_holds(folder):
    rng = np.random.default_rng(0)
    with Dataset.create(folder / "data") as dataset:
        inputs = rng.normal(size=(40, 3))
        dataset.append("training", {"x": inputs, "y": inputs[:, :1] * 2})
    network = NetworkConfig(
        "torch/fc",
        {"layers": [3, 4, 1], "net_fields": "x", "opt_fields": "y"},
        loss="MSELoss",
        optimizer="Adam",
        lr=0.01,
    )
    training = Training(
        network,
        DatasetConfig("data"),
        epoch_nb=2,
        batch_size=10,
        statistics=["torch/wandb"],
        statistics_kwargs={"torch/wandb": {"interval": 0}},
    )
    training.execute()
    rows = read(training.session.path)
    assert [row["batch"] for row in rows if "batch" in row] == list(range(1, 9))
    stored = [
        line.split(",")
        for line in (training.session.path / "stats/scalars.csv").read_text().splitlines()[1:]
    ]
    own = [float(value) for timeline, _, name, value in stored if name == "loss/training"]
    assert own and own == [row["loss/training"] for row in rows if "loss/training" in row]
