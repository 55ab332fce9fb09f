"""Pictures that a viewer without a window draws; they need a Vulkan driver."""

from __future__ import annotations

import numpy as np
import psutil
import pytest
from PIL import Image, ImageSequence

from physx_core.components import Factory
from physx_core.errors import ConfigError, VisualizerError
from physx_rerun.viewer import viewer
from physx_rerun.viewer.headless import choose_timeline, render_film, render_picture

pytestmark = pytest.mark.processes


@pytest.fixture
def recording(opened, arm):
    """A robot that turns, beside its translucent copy and a plot."""
    visualizer, factory = opened(), Factory()
    bodies, packages = ["base", "upper"], {"arm_meshes": str(arm.parent / "meshes")}
    factory.add_robot("arm", arm, bodies, package_dirs=packages)
    factory.add_robot("goal", arm, bodies, package_dirs=packages, color="blue", alpha=0.4)
    factory.add_scalars("error", ["angle"])
    for step in range(20):
        turn = [0, 0, 0.05, 0, np.sin(step / 20), 0, np.cos(step / 20)]
        factory.update_robot("arm", poses=[[0, 0, 0, 0, 0, 0, 1], turn])
        factory.update_scalars("error", [np.sin(step / 3)])
        visualizer.events(1, step, factory.take_events())
    visualizer.close()
    return visualizer.file


def pixels(path):
    return np.asarray(Image.open(path).convert("RGB"))


def children():
    return {child.pid for child in psutil.Process().children(recursive=True)}


@pytest.mark.usefixtures("vulkan")
def test_picture_of_two_times(recording, tmp_path):
    before = children()
    path = render_picture(recording, tmp_path / "new" / "a.png", size=(640, 360), at=0)
    first = pixels(path)
    last = pixels(render_picture(recording, tmp_path / "b.png", size=(640, 360)))
    assert children() == before
    assert first.shape == (360, 640, 3)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 200
    assert (first != last).any(axis=2).mean() > 0.005


@pytest.mark.slow
@pytest.mark.usefixtures("vulkan")
def test_a_film_goes_from_the_beginning_to_the_end(recording, tmp_path):
    before, size = children(), (320, 200)
    path = render_film(recording, tmp_path / "new" / "a.webp", size, frames=3, frame_rate=10)
    assert children() == before
    with Image.open(path) as film:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
        assert film.info["duration"] == 100
    assert len(frames) == 3
    for frame, at in ((frames[0], 0), (frames[2], 19)):
        still = pixels(render_picture(recording, tmp_path / "still.png", size, at=at))
        assert np.abs(still.astype(int) - frame).mean() < 4  # what compression changes
    assert (frames[0] != frames[1]).any() and (frames[1] != frames[2]).any()


@pytest.mark.parametrize(
    ("name", "frames", "reason"),
    [("a.gif", 3, r"must be a \.webp file, not a\.gif"), ("a.webp", 1, "at least 2 frames, not 1")],
)
def test_a_film_that_cannot_be_made(name, frames, reason, tmp_path):
    with pytest.raises(ConfigError, match=reason):
        render_film(tmp_path / "none.rrd", tmp_path / name, frames=frames)


@pytest.mark.usefixtures("vulkan")
def test_headless_mode_leaves_a_picture(opened, tmp_path):
    visualizer = opened(mode="headless", picture_size=(320, 200))
    for batch in range(10):
        visualizer.scalars({"loss/training": 1 / (batch + 1)}, batch, "batch")
    visualizer.close()
    assert f"picture: {tmp_path / 'run.png'}" in visualizer.outputs()
    assert pixels(tmp_path / "run.png").shape == (200, 320, 3)


@pytest.mark.parametrize(
    ("known", "chosen"),
    [
        (["time", "step", "sim_time"], "step"),
        (["time", "epoch", "batch"], "epoch"),
        (["step", "time", "batch"], "time"),
        (["epoch", "row", "time"], "time"),
        (["step", "batch"], "step"),
        (["frame"], "frame"),
    ],
)
def test_scenes_and_curves_of_a_training_are_shown_on_a_timeline_that_both_have(known, chosen):
    assert choose_timeline(known) == chosen


@pytest.mark.usefixtures("vulkan")
def test_unknown_timeline(recording, tmp_path):
    with pytest.raises(VisualizerError, match=r"no timeline \"epoch\".*step"):
        render_picture(recording, tmp_path / "a.png", timeline="epoch", size=(64, 64))


def test_without_a_driver_the_remedy_is_named(recording, tmp_path, monkeypatch):
    before = children()
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "none.json"))
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    with pytest.raises(VisualizerError, match="apt install mesa-vulkan-drivers"):
        render_picture(recording, tmp_path / "a.png")
    assert children() == before


@pytest.mark.usefixtures("vulkan")
@pytest.mark.parametrize(("title", "glyph"), [("温度", "温.*U\\+6E29"), ("🤖", "🤖.*U\\+1F916")])
def test_a_title_that_the_viewers_font_cannot_show_is_named(title, glyph, opened, tmp_path):
    visualizer, factory = opened(mode="headless", picture_size=(64, 64)), Factory()
    factory.set_view(title)
    factory.add_sphere("ball", radius=0.1)
    visualizer.events(1, 0, factory.take_events())
    with pytest.raises(VisualizerError, match=f"no glyph for .{glyph}.*Use other characters"):
        visualizer.close()
    assert visualizer.outputs()[0].startswith(f"recording: {tmp_path / 'run.rrd'}")


def test_no_recording(tmp_path):
    with pytest.raises(VisualizerError, match=r"no recording .*none\.rrd"):
        render_picture(tmp_path / "none.rrd", tmp_path / "a.png")
    with pytest.raises(VisualizerError, match=r"no recording .*none\.rrd"):
        render_film(tmp_path / "none.rrd", tmp_path / "a.webp")


def test_the_viewer_is_only_reachable_from_this_machine(receiver):
    listening = psutil.Process(receiver[0].process.pid).net_connections(kind="tcp")
    addresses = {c.laddr.ip for c in listening if c.status == psutil.CONN_LISTEN}
    assert addresses == {"127.0.0.1"}


def test_a_port_that_is_free():
    assert not viewer.is_listening(f"127.0.0.1:{viewer.find_free_port()}")
