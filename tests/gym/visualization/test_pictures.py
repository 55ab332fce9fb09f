"""The pictures of the documentation show what is drawn today; they need a Vulkan driver."""

import os
import runpy
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from physx_core.errors import VisualizerError

pytestmark = pytest.mark.processes

DOCS = Path(__file__).parents[3] / "docs"
PICTURES = runpy.run_path(str(DOCS / "pictures.py"))
SIZE = (320, 240)


def small(picture):
    return np.asarray(Image.fromarray(picture).convert("L").resize((40, 30)), float)


def drawn_or_skipped(draw, *given):
    """Return what is drawn; skip without a driver, which continuous integration must have."""
    try:
        return draw(*given)
    except VisualizerError as error:
        if "Vulkan" not in str(error) or os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))


@pytest.mark.parametrize("place", range(len(PICTURES["NAMES"])), ids=PICTURES["NAMES"].__getitem__)
def test_a_picture_of_each_environment_is_as_documented(place):
    row, column = divmod(place, PICTURES["COLUMNS"])
    documented = np.asarray(Image.open(DOCS / "environments.png").convert("RGB"))
    tile = documented[SIZE[1] * row :, SIZE[0] * column :][: SIZE[1], : SIZE[0]]
    drawn = drawn_or_skipped(PICTURES["picture"], PICTURES["NAMES"][place], SIZE)
    assert (drawn.max(axis=2) > 135).mean() > 0.003  # lighter than sky and ground
    assert np.abs(small(drawn) - small(tile)).mean() < 5


def test_the_picture_of_the_demo_shows_the_arms_and_their_errors():
    PICTURES["check_demo"](PICTURES["DEMO"])


@pytest.mark.faults
def test_a_replay_with_contacts_plots_and_a_ghost_is_as_documented(tmp_path):
    drawn_or_skipped(PICTURES["replay"], tmp_path / "replay.png", (750, 400))
    for path in (DOCS / "replay.png", tmp_path / "replay.png"):
        picture = Image.open(path).convert("RGB")
        width, height = picture.size
        scene = picture.crop((0, height // 10, width // 2, height * 9 // 10))
        found = PICTURES["shares"](np.asarray(scene))
        least = {"light": 0.01, "red": 0.0005, "blue": 0.005, "yellow": 0.0005}  # blue: the ghost
        assert all(found[color] > share for color, share in least.items()), (path, found)
        for row in np.array_split(np.asarray(picture.crop((width // 2, 0, width, height))), 3):
            for plot in np.array_split(row, 3, axis=1):
                assert PICTURES["shares"](plot)["blue"] > 0.001, path


@pytest.mark.faults
def test_the_picture_of_the_page_about_the_viewer_is_what_its_code_draws():
    drawn = drawn_or_skipped(PICTURES["spring"])
    documented = np.asarray(Image.open(DOCS / "learn" / "spring.png").convert("RGB"))
    assert drawn.shape == documented.shape
    for picture in (drawn, documented):
        assert PICTURES["shares"](picture)["orange"] > 0.001
    assert np.abs(small(drawn) - small(documented)).mean() < 5


SCENES = {  # rows and columns in the sheet, and the least shares of the colors of its objects
    "arm": ((30, 290), (0, 330), {"light": 0.01, "green": 0.005}),
    "beam": ((30, 290), (335, 665), {"orange": 0.002, "blue": 0.01, "light": 0.004}),
    "cloud": ((30, 290), (668, 1000), {"light": 0.0005, "green": 0.0001, "orange": 0.0001}),
    "push_box": ((550, 830), (0, 499), {"orange": 0.01, "light": 0.01, "red": 0.0002}),
    "quadruped": ((550, 830), (502, 1000), {"light": 0.005, "red": 0.0002}),
    "matplotlib": ((860, 1200), (0, 1000), {"orange": 0.001, "blue": 0.0002, "red": 0.001}),
}


class Errors:
    """Keeps the errors that the beam draws: of linear elasticity and of the network."""

    def __init__(self):
        self.found = []

    def open(self, name, folder, count):
        assert count == 3

    def events(self, number, step, events):
        drawn = [event for event in events if event.name == "error" and event.action == "update"]
        self.found += [event.values["values"] for event in drawn]


@pytest.mark.faults
def test_a_picture_of_each_example_is_as_documented():
    pytest.importorskip("felupe", reason="needs felupe, which solves the beam")
    pytest.importorskip("matplotlib")
    documented = np.asarray(Image.open(DOCS / "examples.png").convert("RGB"))
    errors = Errors()
    scenes = drawn_or_skipped(partial(PICTURES["examples"], errors, pushes=400, clouds=5000))
    drawn = np.asarray(PICTURES["sheet"](scenes).convert("RGB"))
    assert drawn.shape == documented.shape
    for name, (rows, columns, colors) in SCENES.items():
        old, new = (each[slice(*rows), slice(*columns)] for each in (documented, drawn))
        found = PICTURES["shares"](new)
        assert all(found[color] > least for color, least in colors.items()), (name, found)
        assert np.abs(small(new) - small(old)).mean() < 5, name
    linear, network = np.median(errors.found, axis=0)  # nothing else may be called a network
    assert len(errors.found) == 10 and network < 0.5 * linear
