"""What goes wrong in other systems of this kind: each case ends well here, or in a clear error."""

from __future__ import annotations

import math
import signal
import socket
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
    Environment,
    EnvironmentConfig,
    Field,
    NetworkConfig,
    Prediction,
    Training,
    View,
)
from physx_core.components import options_of
from physx_core.errors import (
    ConfigError,
    DatasetNotFoundError,
    EnvironmentFailedError,
    FieldShapeError,
    FieldTypeError,
    MissingFieldError,
    ReferenceFormError,
    SampleError,
    UnknownFieldError,
    UsageError,
)

ALL = View(hold_back=False)

pytestmark = pytest.mark.processes

SPRING = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
NETWORK = NetworkConfig("toy/linear", network_kwargs={"net_fields": ["state", "force"]})


def rows_of(place, mode="training"):
    with Dataset.open(place) as dataset:
        assert dataset.verify() == []
        return {name: view[:] for name, view in dataset[mode].items()}


def content(folder):
    return {path: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


class Faulty(Environment):
    """Does something wrong in one of its steps."""

    closed = 0

    def __init__(self, *, fault="", at=0, **kwargs):
        super().__init__(**kwargs)
        self.fault, self.at = fault, at

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([("x", np.ndarray), Field("label", dtype="int64")])
        self.define_additional_fields(("note", np.ndarray))

    def step(self):
        data = {"x": np.arange(2.0), "label": 3, "note": np.zeros(3)}
        if self.step_index == self.at:
            data = self.spoilt(data)
        if data:
            self.set_additional_data(note=data.pop("note")) if "note" in data else None
            self.set_training_data(**data)

    def spoilt(self, data):
        if self.fault == "raises":
            raise RuntimeError("the solver diverged")
        if self.fault == "nothing":
            return {}
        return {
            "no field": {name: data[name] for name in data if name != "label"},
            "no additional data": {name: data[name] for name in data if name != "note"},
            "unknown field": data | {"speed": 1.0},
            "another shape": data | {"x": np.arange(3.0)},
            "text": data | {"x": "text"},
            "objects": data | {"x": np.array([None, {}])},
            "list": data | {"x": [5, 7]},
        }[self.fault]

    def close(self):
        type(self).closed += 1


def generate(fault, at, **options):
    config = EnvironmentConfig(Faulty, {"fault": fault, "at": at}, as_tcp_ip_client=False)
    DataGeneration(config, session_name="run", batch_nb=3, batch_size=4, **options).execute()


# Data that cannot be stored -----------------------------------------------------------------------


@pytest.mark.parametrize("at", [0, 6])
@pytest.mark.parametrize(
    ("fault", "error", "named"),
    [
        ("nothing", MissingFieldError, "did not set any data: call set_training_data"),
        ("no field", MissingFieldError, '"label"'),
        ("no additional data", MissingFieldError, '"note"'),
        ("unknown field", UnknownFieldError, '"speed"'),
        ("another shape", FieldShapeError, '"x"'),
        ("text", SampleError, '"x"'),
        ("objects", FieldTypeError, '"x"'),
    ],
)
def test_bad_data_are_named_in_whichever_step_they_come(fault, error, named, at):
    if fault == "another shape" and at == 0:
        at = 2  # the first sample decides the shape
    with pytest.raises(error, match=named) as caught:
        generate(fault, at)
    assert (caught.value.instance_id, caught.value.step) == (1, at)
    stored = at // 4 * 4
    if not stored:
        assert not Path("sessions/run").exists()
        return
    with Dataset.open("sessions/run") as dataset:
        assert dataset.num_samples("training") == stored


def test_lists_of_numbers_are_arrays():
    generate("list", 5)
    rows = rows_of("sessions/run")
    assert rows["x"][5].tolist() == [5, 7] and rows["x"].dtype == float


# Runs that end early ------------------------------------------------------------------------------


def test_a_step_that_raises_keeps_whole_batches_and_closes_the_environment():
    Faulty.closed = 0
    with pytest.raises(EnvironmentFailedError, match="the solver diverged"):
        generate("raises", 9)
    assert Faulty.closed == 1
    assert len(rows_of("sessions/run")["x"]) == 8
    folders = sorted(path.name for path in Path("sessions/run").iterdir())
    assert folders == ["config.toml", "dataset", "info.txt", "stats"]
    names = {path.name for path in Path("sessions/run/dataset").iterdir()}
    fields = ["x", "label", "note", "env_id", "episode", "step"]
    partitions = {f"run_training_{field}_0.h5" for field in fields}
    assert {name for name in names if not name.startswith("statistics_")} == {
        "dataset.json", "dataset.lock", "run.h5", *partitions
    }  # fmt: skip
    generate("", -1, new_session=False)  # nothing is in the way of the next run
    assert len(rows_of("sessions/run")["x"]) == 20


def test_a_taken_port_leaves_no_session_behind():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        config = EnvironmentConfig("toy/spring", port=taken.getsockname()[1])
        with pytest.raises(ConfigError, match=str(config.port)):
            DataGeneration(config, batch_nb=1, batch_size=1).execute()
    assert not list(Path("sessions").glob("*"))


ENDLESS = """
from physx_core import *
if __name__ == "__main__":
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=0)
    DataGeneration(spring, session_name="run", batch_nb=10**9, batch_size=7).execute()
"""


def test_after_kill_9_all_fields_have_the_same_rows_and_more_can_be_added():
    Path("endless.py").write_text(ENDLESS)
    process = subprocess.Popen([sys.executable, "endless.py"])
    file, deadline = Path("sessions/run/dataset/run_training_state_0.h5"), time.monotonic() + 60
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.1)
    process.send_signal(signal.SIGKILL)
    process.wait(60)
    before = rows_of("sessions/run")
    DataGeneration(
        SPRING, session_name="run", new_session=False, batch_nb=1, batch_size=5
    ).execute()
    rows = rows_of("sessions/run")
    count = len(before["state"])
    assert {len(values) for values in before.values()} == {count} and count % 7 == 0
    assert {len(values) for values in rows.values()} == {count + 5}
    for name in ("state", "force", "next_state"):
        assert np.array_equal(rows[name][:count], before[name])
    for part in (slice(count), slice(count, None)):  # the fields of a row belong together
        assert np.array_equal(rows["state"][part][1:], rows["next_state"][part][:-1])


# Trainings and predictions ------------------------------------------------------------------------


@pytest.mark.parametrize("recompute", [False, True])
def test_old_data_are_normalized_without_touching_them(recompute):
    """Made without a thought of normalization, with a component that never changes."""
    rng = np.random.default_rng(0)
    state = np.column_stack([rng.normal(5, 2, 60), np.full(60, 3.0)])
    with Dataset.create("data") as dataset:
        dataset.append("training", {"state": state, "next_state": 2 * state})
    before = content("data")
    config = DatasetConfig(
        existing_dir="data", view=ALL, normalize=True, recompute_normalization=recompute
    )
    with Training(NetworkConfig("toy/linear"), config, epoch_nb=1, batch_size=60) as training:
        training.execute()
        used = training.learner.transformation.normalization
    assert np.allclose(used["state"].mean, state.mean(axis=0))
    assert np.allclose(used["state"].std, [state[:, 0].std(), 1])
    assert math.isfinite(training.training_loss)
    assert content("data") == before


def test_what_normalizes_grows_with_the_samples_that_environments_make():
    seen = []

    class Mine(Training):
        def batch_end(self):
            stored = self.data.dataset["training"]["state"][:]
            used = self.learner.transformation.normalization["state"]
            seen.append((len(stored), np.allclose(used.mean, stored.mean(axis=0))))

    Mine(
        NETWORK, DatasetConfig(normalize=True), SPRING, epoch_nb=1, batch_nb=3, batch_size=10
    ).execute()
    assert seen == [(10, True), (20, True), (30, True)]


def test_batches_have_their_size_however_small_the_dataset_is():
    DataGeneration(SPRING, session_name="run", batch_nb=1, batch_size=10).execute()
    batches = []

    class Mine(Training):
        def batch_end(self):
            batches.append(self.batch["force"][:, 0].copy())

    for size, batch_nb, sizes in ((8, 5, [8, 2, 8, 2, 8]), (16, 2, [10, 10])):
        del batches[:]
        Mine(
            NETWORK, DatasetConfig(existing_dir="sessions/run", view=ALL),
            epoch_nb=1, batch_nb=batch_nb, batch_size=size,
        ).execute()  # fmt: skip
        assert [len(batch) for batch in batches] == sizes
    assert all(len(np.unique(batch)) == 10 for batch in batches)  # each pass is a permutation
    assert not np.array_equal(*batches)


def test_a_recorded_prediction_leaves_the_data_alone_that_were_learned_from():
    DataGeneration(SPRING, session_name="run", batch_nb=1, batch_size=20).execute()
    before = content("sessions/run")
    Training(
        NETWORK, DatasetConfig(existing_dir="sessions/run", view=ALL), epoch_nb=1, batch_size=20
    ).execute()
    for _ in range(2):
        Prediction(NetworkConfig(), SPRING, step_nb=3, record=True).execute()
    assert content("sessions/run") == before
    assert not Path("sessions/training/dataset").is_symlink()
    assert len(rows_of("sessions/training", "prediction")["state"]) == 6


def test_a_training_needs_samples_from_somewhere():
    with pytest.raises(DatasetNotFoundError) as caught:
        Training(NETWORK, epoch_nb=1, batch_size=1).execute()
    assert (
        "DatasetConfig.existing_dir, or an environment that generates" in caught.value.__notes__[0]
    )
    assert not list(Path("sessions").glob("*"))


# Environments -------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["create", "init_database", "step"])
def test_what_an_environment_must_have_is_named(method):
    class Without(Faulty):
        pass

    setattr(Without, method, getattr(Environment, method))
    with pytest.raises(UsageError, match=rf"Without does not implement {method}\(\)"):
        DataGeneration(
            EnvironmentConfig(Without, as_tcp_ip_client=False), batch_nb=1, batch_size=1
        ).execute()
    assert options_of(Without) == ["fault", "at"]


def test_a_class_that_is_no_environment_is_refused():
    for reference, message in {
        "collections:Counter": "standard library",
        "physx_core.toy:Linear": "not derived from Environment",
    }.items():
        config = EnvironmentConfig(reference, as_tcp_ip_client=False)
        with pytest.raises(ReferenceFormError, match=message):
            DataGeneration(config, batch_nb=1, batch_size=1).execute()
