"""What the viewer shows of a training: curves, histograms, predictions, notes, in the picture."""

from __future__ import annotations

import math

import numpy as np
import pytest
import rerun.blueprint as rrb
from PIL import Image

from physx_core import Dataset, DatasetConfig, Field, NetworkConfig, Training
from physx_rerun.drawing.chunks import ChunkBuilder
from physx_rerun.drawing.colors import CURVES
from physx_rerun.drawing.dashboard import Dashboard

pytestmark = pytest.mark.processes

TIMES = {"batch": 0, "epoch": 0, "time": 0.0}


def feed(visualizer, batches=120, epochs=4):
    """Record a training whose loss decays."""
    random = np.random.default_rng(0)
    visualizer.fields([Field("force", (2,), unit="N")])
    for batch in range(batches):
        mean = math.exp(-batch / 20)
        values = {"loss/batch": mean, "loss/mean": mean, "loss/variance": 0.1 * mean**2}
        visualizer.scalars(values, batch, "batch")
        if batch % (batches // epochs) == batches // epochs - 1:
            epoch = batch // (batches // epochs) + 1
            losses = {"loss/training": mean, "loss/validation": 3 * mean, "learning_rate": 1e-3}
            visualizer.scalars(losses, epoch, "epoch")
            weights = random.normal(size=3000) * 0.02
            visualizer.histograms({"weights/layers.0.weight": weights}, epoch, "epoch")
            truth = {"force": random.uniform(-1, 1, (64, 2))}
            predicted = {"force": truth["force"] + 0.02 * random.normal(size=(64, 2))}
            visualizer.predictions(predicted, truth, epoch, "epoch")


def titles(cells):
    views = [cell.contents if isinstance(cell, rrb.Tabs) else [cell] for cell in cells]
    return [[view.name for view in group] for group in views]


def test_losses_have_logarithms_and_batches_a_band(opened, read):
    visualizer = opened()
    feed(visualizer)
    visualizer.close()
    file = visualizer.file
    raw = read(file, "/run/loss/validation", "Scalars:scalars", "epoch")
    assert raw[-1] == (4, [pytest.approx(3 * math.exp(-119 / 20))])
    shown = read(file, "/run/log10/loss/validation", "Scalars:scalars", "epoch")
    assert shown[-1] == (4, [pytest.approx(math.log10(raw[-1][1][0]))])
    assert len(read(file, "/run/loss/mean", "Scalars:scalars", "batch")) == 120
    (_, mean), *_ = read(file, "/run/band/loss/mean", "Measurements:values", "batch")[1:]
    (_, variance), *_ = read(file, "/run/band/loss/mean", "Measurements:variances", "batch")[1:]
    assert variance[0] == pytest.approx(0.1 * mean[0] ** 2)
    spread = read(file, "/run/log10/loss/mean", "Measurements:variances", "batch")[0][1][0]
    assert spread == pytest.approx(math.log10(1 + math.sqrt(0.1)) ** 2)


def test_windows_are_named_and_losses_come_first():
    dashboard = Dashboard(ChunkBuilder())
    dashboard.fields([Field("force", unit="N"), Field("state", (2,))])
    dashboard.histograms({"gradients/0.weight": np.arange(9.0)}, TIMES)
    figures = {"mean": 0.0, "std": 1.0, "q05": -2.0, "median": 0.1, "q95": 2.0}
    dashboard.scalars({f"fields/force/{k}": v for k, v in figures.items()}, TIMES)
    dashboard.scalars({f"fields/state/1/{k}": v for k, v in figures.items()}, TIMES)
    dashboard.scalars({"online/views": 1.0, "online/rows_per_s": 9.0, "accuracy/batch": 0.5}, TIMES)
    dashboard.scalars({"loss/batch": 2.0, "loss/mean": 2.0, "loss/variance": 0.0}, TIMES)
    dashboard.scalars({"loss/training": 2.0, "loss/training_mean": 2.0}, TIMES)
    dashboard.note("stopped early", TIMES)
    assert dashboard.changed
    cells = dashboard.cells()
    assert not dashboard.changed
    assert titles(cells) == [
        ["loss per epoch (log10)"],
        ["loss per batch (log10)"],
        ["fields: force (N)", "fields: state"],
        ["online: views per row", "online: rates (1/s)"],
        ["accuracy per batch"],
        ["gradients: 0.weight"],
        ["notes"],
    ]
    assert cells[0].contents == ["run/log10/loss/training"]
    fields = cells[2].contents
    assert fields[1].contents == [
        "run/band/fields/state/1/mean",
        "run/fields/state/1/q05",
        "run/fields/state/1/q95",
    ]


def test_a_loss_that_is_not_positive_is_shown_as_it_is():
    dashboard = Dashboard(ChunkBuilder())
    for value in (1.0, math.nan, 0.1):
        dashboard.scalars({"loss/training": value}, TIMES)
    assert titles(dashboard.cells()) == [["loss per epoch (log10)"]]
    dashboard.scalars({"loss/training": -0.1}, TIMES)
    assert dashboard.changed
    (cell,) = dashboard.cells()
    assert (cell.name, cell.contents) == ("loss per epoch", ["run/loss/training"])


def test_bars_are_as_wide_as_their_bins(opened, read):
    visualizer = opened()
    feed(visualizer)
    visualizer.close()
    widths = read(visualizer.file, "/run/weights/layers.0.weight", "BarChart:widths", "epoch")
    assert [epoch for epoch, _ in widths] == [1, 2, 3, 4]
    assert len(widths[0][1]) == 30 and 0.002 < widths[0][1][0] < 0.01


def test_the_network_is_compared_with_the_truth_of_validation_samples(tmp_path, opened, read):
    random = np.random.default_rng(0)
    with Dataset.create(tmp_path / "data") as dataset:
        for mode in ("training", "validation"):
            x = random.normal(size=(200, 2))
            dataset.append(mode, {"x": x, "y": x @ [[1.0], [2.0]]})
    network = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "y"})
    training = Training(
        network,
        DatasetConfig(existing_dir=str(tmp_path / "data")),
        session_dir=str(tmp_path / "sessions"),
        epoch_nb=3,
        batch_size=20,
        statistics=["rerun"],
        statistics_kwargs={"rerun": {"path": tmp_path / "a.rrd"}},
        quiet=True,
    )
    training.execute()
    rows = read(tmp_path / "a.rrd", "/run/predictions/y/values", "Points2D:positions", "epoch")
    assert [epoch for epoch, _ in rows] == [1, 2, 3]
    places = np.array(rows[-1][1])
    assert places.shape == (64, 2)
    np.testing.assert_allclose(places[:, 0], -places[:, 1], atol=1e-6)  # it has learned this
    (text,) = read(tmp_path / "a.rrd", "/run/configuration", "TextDocument:text")[0][1]
    assert 'network = "toy/linear"' in text
    name = "training.network.network"
    assert read(tmp_path / "a.rrd", "/__properties/configuration", name)[0][1] == ["toy/linear"]


def test_a_note_is_in_the_recording(opened, read):
    visualizer = opened()
    visualizer.scalars({"loss/training": 1.0}, 3, "epoch")
    visualizer.note("The training stopped early.")
    visualizer.close()
    rows = read(visualizer.file, "/run/notes", "TextLog:text", "epoch")
    assert rows == [(3, ["The training stopped early."])]


@pytest.mark.slow
@pytest.mark.usefixtures("vulkan")
def test_the_picture_can_be_read(opened, tmp_path):
    """Each cell shows its curves, bars and points; nothing is a solid block."""
    picture = tmp_path / "dashboard.png"
    visualizer = opened(mode="headless", picture=picture, picture_size=(1200, 600))
    feed(visualizer)
    visualizer.close()
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    height, width = pixels.shape[:2]
    half, third = height // 2, width // 3
    cells = [
        pixels[row * half : (row + 1) * half, column * third : (column + 1) * third]
        for row in range(2)
        for column in range(3)
    ]

    def columns(cell, color):
        """Return the share of columns with a pixel of a color, which may be darker: thin lines."""
        wanted = np.array([int(color[first : first + 2], 16) for first in (1, 3, 5)])
        length = np.linalg.norm(cell, axis=2) + 1e-9
        similar = cell @ wanted / np.linalg.norm(wanted) / length
        return ((similar > 0.97) & (length > 90)).any(axis=0).mean()

    losses, batches, rate, predictions, weights = cells[:5]
    assert columns(losses, CURVES[0]) > 0.5  # training
    assert columns(losses, CURVES[1]) > 0.5  # validation
    assert columns(batches, CURVES[0]) > 0.5
    assert columns(rate, CURVES[0]) > 0.5
    for color in CURVES[:2]:
        assert columns(predictions, color) > 0.15
    bars = (weights[30:-40].max(axis=2) > 70).mean(axis=0)  # share of each column that is bright
    assert 0.3 < (bars > 0).mean() < 0.97
    assert (bars > 0.95).mean() < 0.2  # no block
    assert bars.max() > 2 * np.median(bars[bars > 0])
