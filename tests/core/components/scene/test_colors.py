from __future__ import annotations

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import CSS4_COLORS

from physx_core.components.scene.colors import NAMES, colormap, map_values, parse_color
from physx_core.errors import ConfigError


@pytest.mark.parametrize(
    ("color", "expected"),
    [
        ("#ff8000", (255, 128, 0)),
        ("black", (0, 0, 0)),
        ("White", (255, 255, 255)),
        ("tomato", (255, 99, 71)),
        ((1.0, 0.0, 0.2), (255, 0, 51)),
        (np.array([0, 0, 1]), (0, 0, 255)),
    ],
)
def test_every_form_of_a_color(color, expected):
    assert tuple(round(255 * part) for part in parse_color(color)) == expected


def test_all_colors_of_css_have_their_names():
    assert {name: f"#{number}" for name, number in NAMES.items()} == {
        name: number.lower() for name, number in CSS4_COLORS.items()
    }


@pytest.mark.parametrize(
    "color", ["gren", "#12", "ff0000", "#gggggg", (1, 2, 3), (0.1, 0.2), "#-12345", None]
)
def test_what_is_no_color(color):
    with pytest.raises(ConfigError, match="color"):
        parse_color(color)


def test_a_near_name_is_suggested():
    with pytest.raises(ConfigError, match='Did you mean "green"'):
        parse_color("gren")


def test_all_colormaps_of_matplotlib_have_their_colors():
    middles = (np.arange(256) + 0.5) / 256
    for name, known in matplotlib.colormaps.items():
        expected = np.round(255 * known(middles)[:, :3])
        assert np.abs(colormap(name) - expected).max() <= 1, name


def test_colormap_runs_from_first_to_last_color():
    mapped = map_values(np.array([-1.0, 0.0, 1.0, 2.0, 9.0]), 0.0, 2.0, "gray")
    assert mapped[:, 0].tolist() == [0, 0, 128, 255, 255]
    assert map_values(np.array([0.0]), 0.0, 2.0, "gray_r").tolist() == [[255, 255, 255]]


def test_unknown_colormap():
    with pytest.raises(ConfigError, match='Did you mean "viridis"'):
        colormap("viridi")
