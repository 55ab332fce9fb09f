"""physx snapshot: pictures of recordings and datasets; they need a Vulkan driver."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from physx_core import Dataset
from physx_core.components import Factory
from physx_core.errors import UsageError, VisualizerError
from physx_rerun.cli import snapshot

pytestmark = pytest.mark.processes

SIZE = ("--width", "320", "--height", "200")


@pytest.fixture
def session(opened, tmp_path):
    """A box that crosses the window, at 10 steps a second."""
    visualizer, factory = opened(path=tmp_path / "session" / "run.rrd"), Factory()
    factory.add_box("box", (0.2, 0.2, 0.2), color="orange")
    factory.add_sphere("mark", 0.05, position=(1.5, 0.0, 0.0))
    for step in range(11):
        factory.set_time(step / 10)
        factory.update_box("box", position=(step / 10, 0.0, 0.0))
        visualizer.events(1, step, factory.take_events())
    visualizer.close()
    return tmp_path / "session"


def orange(path):
    """Return the mean column of the orange pixels."""
    red, _, blue = np.moveaxis(np.asarray(Image.open(path).convert("RGB"), int), -1, 0)
    return np.nonzero(red - blue > 60)[1].mean()


@pytest.mark.slow
@pytest.mark.usefixtures("vulkan")
def test_a_picture_at_a_step_or_a_time_or_the_end(session, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    places = []
    for at in (["--at", "0"], ["--at", "0.5s"], []):
        snapshot.run([str(session), *at, *SIZE, "-o", "out/a.png"])
        assert capsys.readouterr().out == "picture: out/a.png\n"
        places.append(orange("out/a.png"))
    assert places[0] < places[1] - 5 < places[2] - 10


@pytest.mark.usefixtures("vulkan")
def test_a_time_that_there_is_not(session):
    with pytest.raises(VisualizerError, match=r'"sim_time" begins at 0 and ends at 1: .* at 7'):
        snapshot.run([str(session), "--at", "7s", *SIZE])


@pytest.mark.usefixtures("vulkan")
def test_a_picture_of_a_dataset(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Dataset.create("data", session="run") as dataset:
        dataset.append("training", {"cloud": np.random.default_rng(0).random((4, 9, 3))})
    snapshot.run(["data", "--at", "2", *SIZE])
    assert Image.open("data.png").size == (320, 200)
    note = np.asarray(Image.open("data.png").convert("L"))[2:30, 100:310]
    assert (note > 150).mean() < 0.05  # nothing of the viewer's own is shown over it
    assert {path.name for path in tmp_path.iterdir()} == {"data", "data.png"}


def test_neither_a_step_nor_a_time(session):
    with pytest.raises(UsageError, match='--at is "soon"'):
        snapshot.run([str(session), "--at", "soon"])
