"""The pictures of the documentation show what is drawn today; they need a Vulkan driver."""

import os
import runpy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from physx_core.errors import VisualizerError

DOCS = Path(__file__).parents[3] / "docs"
PICTURES = runpy.run_path(str(DOCS / "pictures.py"))
SIZE = (320, 240)


def small(picture):
    return np.asarray(Image.fromarray(picture).convert("L").resize((40, 30)), float)


@pytest.mark.parametrize("place", range(len(PICTURES["NAMES"])), ids=PICTURES["NAMES"].__getitem__)
def test_a_picture_of_each_environment_is_as_documented(place):
    row, column = divmod(place, PICTURES["COLUMNS"])
    documented = np.asarray(Image.open(DOCS / "environments.png").convert("RGB"))
    tile = documented[SIZE[1] * row :, SIZE[0] * column :][: SIZE[1], : SIZE[0]]
    try:
        drawn = PICTURES["picture"](PICTURES["NAMES"][place], SIZE)
    except VisualizerError as error:
        if "Vulkan" not in str(error) or os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))
    assert (drawn.max(axis=2) > 135).mean() > 0.003  # lighter than sky and ground
    assert np.abs(small(drawn) - small(tile)).mean() < 5
