"""Pictures one after another from a viewer without a window; they need a Vulkan driver."""

from __future__ import annotations

import numpy as np
import psutil
import pytest

from physx_core.components import Factory
from physx_core.errors import VisualizerError
from physx_rerun.visualizer import RerunVisualizer

pytestmark = pytest.mark.processes

SIZE = (96, 64)


@pytest.fixture
def offscreen(opened):
    return lambda: opened(mode="offscreen", save=False, picture_size=SIZE)


def children():
    return {child.pid for child in psutil.Process().children(recursive=True)}


def test_other_modes_make_no_pictures(opened):
    assert opened().capture() is None
    assert RerunVisualizer().capture() is None


@pytest.mark.usefixtures("vulkan")
def test_each_picture_shows_the_last_step(offscreen):
    before = children()
    visualizer, factory = offscreen(), Factory()
    factory.add_box("box", (0.2, 0.2, 0.2), color="orange")
    factory.add_sphere("mark", 0.05, position=(1.5, 0.0, 0.0))
    pictures = []
    for step, x in enumerate((0.0, 0.0, 0.5, 1.0, 0.0)):
        factory.update_box("box", position=(x, 0.0, 0.0))
        visualizer.events(1, step, factory.take_events())
        pictures.append(visualizer.capture())
    assert all(each.shape == (64, 96, 3) and each.dtype == np.uint8 for each in pictures)
    same = [[np.array_equal(a, b) for a in pictures] for b in pictures]
    assert same[0] == [True, True, False, False, True]
    assert same[2] == [False, False, True, False, False]
    visualizer.close()
    assert children() == before


@pytest.mark.usefixtures("vulkan")
def test_the_camera_follows(offscreen):
    pictures = []
    for follow in ("box", None):
        visualizer, factory = offscreen(), Factory()
        factory.set_view("scene", follow)
        factory.add_box("box", (0.2, 0.2, 0.2), color="orange")
        for step in range(2):
            factory.update_box("box", position=(5.0 * step, 0.0, 0.0))
            visualizer.events(1, step, factory.take_events())
            pictures.append(is_orange(visualizer.capture()).mean())
        visualizer.close()
    assert pictures[1] > 0.8 * pictures[0] > 0
    assert pictures[3] < 0.2 * pictures[2]


def is_orange(picture):
    red, _, blue = np.moveaxis(picture.astype(int), -1, 0)
    return red - blue > 60


@pytest.mark.usefixtures("vulkan")
def test_a_viewer_that_is_gone(offscreen):
    before = psutil.Process().children()
    visualizer, factory = offscreen(), Factory()
    factory.add_points("points", np.zeros((1, 3)))
    visualizer.events(1, 0, factory.take_events())
    visualizer.capture()
    begun = [each for each in psutil.Process().children() if each not in before]
    (viewer,) = (each for each in begun if "--headless" in each.cmdline())
    viewer.kill()
    with pytest.raises(VisualizerError, match="The Rerun viewer ended with status -9"):
        visualizer.capture()


def test_without_a_driver_the_remedy_is_named(tmp_path, monkeypatch):
    before = children()
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "none.json"))
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    factory = Factory()
    factory.add_points("points", np.zeros((1, 3)))
    visualizer = RerunVisualizer(mode="offscreen", save=False, picture_size=SIZE)
    with pytest.raises(VisualizerError, match="apt install mesa-vulkan-drivers"):
        visualizer.open("run", tmp_path, 1)
        visualizer.events(1, 0, factory.take_events())
        visualizer.capture()
    visualizer.close()
    assert children() == before
