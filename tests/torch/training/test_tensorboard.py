"""What is written for TensorBoard, read back with TensorBoard's own reader."""

import sys
from pathlib import Path

import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    Environment,
    EnvironmentConfig,
    NetworkConfig,
    Training,
    View,
)
from physx_core.components import Factory
from physx_core.errors import ConfigError, MissingLibraryError
from physx_torch import TensorBoard

events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
arrays = pytest.importorskip("tensorboard.util.tensor_util")
ALL = {"scalars": 0, "histograms": 0, "tensors": 0}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def board(tmp_path):
    """An open observer that leaves nothing out."""
    board = TensorBoard(interval=0, drawing_interval=0)
    board.open("run", tmp_path, 1)
    yield board
    board.close()


def read(session):
    found = events.EventAccumulator(str(Path(session) / "stats" / "tensorboard"), ALL)
    found.Reload()
    return found


def points(found, tag):
    return [(event.step, event.value) for event in found.Scalars(tag)]


def test_numbers(board, folder):
    for step in (1, 2, 3):
        board.scalars({"loss/batch": step / 2, "loss/mean": 1.0}, step, "batch")
    board.scalars({"loss/training": 0.25}, 1, "epoch")
    board.close()
    found = read(folder)
    assert points(found, "loss/batch") == [(1, 0.5), (2, 1.0), (3, 1.5)]
    assert points(found, "loss/training") == [(1, 0.25)]


def test_of_many_batches_some_are_written_and_the_last_one_of_an_epoch(folder):
    board = TensorBoard(interval=1000)
    board.open("run", folder, 1)
    for step in range(1, 100):
        board.scalars({"loss/batch": step}, step, "batch")
    board.scalars({"loss/training": 0.25}, 1, "epoch")
    board.scalars({"loss/batch": 100}, 100, "batch")
    board.close()
    assert points(read(folder), "loss/batch") == [(1, 1), (99, 99), (100, 100)]


def test_histograms_of_finite_numbers(board, folder):
    values = np.array([1.0, 2.0, 3.0, np.nan, np.inf], np.float32)
    board.histograms({"weights/a": values, "weights/b": values[3:]}, 4, "epoch")
    board.close()
    found = read(folder)
    assert found.Tags()["histograms"] == ["weights/a"]
    (event,) = found.Histograms("weights/a")
    histogram = event.histogram_value
    assert (event.step, histogram.min, histogram.max, histogram.num) == (4, 1, 3, 3)


def test_points_and_meshes_that_environments_draw(board, folder):
    factory = Factory()
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    factory.add_mesh("sheet", corners, [[0, 1, 2]], color="#ff0000")
    factory.add_points("cloud", np.zeros((5, 3)), color="green")
    factory.add_sphere("ball", 1.0)
    board.events(2, 0, factory.take_events())
    factory.update_mesh("sheet", positions=np.ones((3, 3)))
    board.events(2, 7, factory.take_events())
    board.close()
    found = read(folder)
    tags = sorted(found.Tags()["tensors"])
    assert tags == [
        "environment_2/cloud_VERTEX",
        "environment_2/sheet_COLOR",
        "environment_2/sheet_FACE",
        "environment_2/sheet_VERTEX",
    ]
    first, second = found.Tensors("environment_2/sheet_VERTEX")
    assert (first.step, second.step) == (0, 7)
    assert arrays.make_ndarray(first.tensor_proto).tolist() == [corners]


def test_a_mesh_with_a_color_for_each_vertex(board, folder):
    board.add_mesh("mine/cloud", np.zeros((2, 3)), color=[[1, 0, 0], [0, 0, 1]], step=3)
    board.close()
    (event,) = read(folder).Tensors("mine/cloud_COLOR")
    colors = arrays.make_ndarray(event.tensor_proto)
    assert event.step == 3 and colors.tolist() == [[[255, 0, 0], [0, 0, 255]]]


def test_before_and_after_a_run_nothing_is_written(folder):
    board = TensorBoard()
    board.scalars({"x": 1.0}, 1, "batch")
    board.histograms({"x": np.ones(3)}, 1, "epoch")
    board.add_mesh("x", np.ones((2, 3)))
    board.note("text")
    board.close()
    assert not list(folder.iterdir())


def test_times_are_not_negative():
    with pytest.raises(ConfigError, match="must not be negative"):
        TensorBoard(interval=-1)


def test_a_missing_library_is_named_with_the_line_that_installs_it(monkeypatch, folder):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(MissingLibraryError, match=r'pip install .*physx.torch\[tensorboard\]"'):
        TensorBoard().open("run", folder, 0)


# In the pipelines -------------------------------------------------------------------------------


def test_a_training_sends_numbers_weights_and_gradients():
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        dataset.append("training", {"x": rng.random((20, 3)), "y": rng.random((20, 2))})
    network = NetworkConfig(
        "torch/fc",
        {"layers": [3, 2], "net_fields": "x", "opt_fields": "y"},
        loss="MSELoss",
        optimizer="Adam",
    )
    pipeline = Training(
        network,
        DatasetConfig(existing_dir="data", view=View(hold_back=False)),
        epoch_nb=4,
        batch_size=5,
        statistics="torch/tensorboard",
        statistics_kwargs={"torch/tensorboard": {"interval": 0.0}},
        histograms_every=2,
    )
    pipeline.execute()
    found = read("sessions/training")
    numbers = ("batch", "mean", "training", "training_mean", "training_variance", "variance")
    scalars = ["learning_rate", *(f"loss/{name}" for name in numbers)]
    assert sorted(found.Tags()["scalars"]) == scalars
    assert len(points(found, "loss/batch")) == 16
    names = [
        f"{kind}/layers.0.{part}"
        for kind in ("gradients", "weights")
        for part in ("bias", "weight")
    ]
    assert sorted(found.Tags()["histograms"]) == names
    assert [event.step for event in found.Histograms("weights/layers.0.bias")] == [2, 4]


class Draws(Environment):
    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([("x", np.ndarray)])

    def init_visualization(self):
        self.factory.add_points("cloud", np.zeros((4, 3)))

    def step(self):
        self.set_training_data(x=np.ones(1))


def test_environments_are_drawn(capsys):
    config = EnvironmentConfig(Draws, as_tcp_ip_client=False, visualizer="torch/tensorboard")
    DataGeneration(config, batch_nb=1, batch_size=2).execute()
    tags = read("sessions/data_generation").Tags()["tensors"]
    assert tags == ["environment_1/cloud_VERTEX"]
    said = capsys.readouterr().err.splitlines()
    assert "curves: sessions/data_generation/stats/tensorboard" in said
    assert "next: physx stats sessions/data_generation --tensorboard" in said


def test_a_board_without_anything_is_not_announced(folder):
    board = TensorBoard()
    board.open("run", folder, 1)
    board.close()
    assert list(board.outputs()) == []
