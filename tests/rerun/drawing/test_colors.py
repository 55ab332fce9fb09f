from __future__ import annotations

import numpy as np
import pytest

from physx_core.errors import ConfigError
from physx_rerun.drawing import colors


@pytest.mark.parametrize(
    ("color", "packed"),
    [
        ("#ff8000", 0xFF8000FF),
        ("black", 0x000000FF),
        ("White", 0xFFFFFFFF),
        ((1.0, 0.0, 0.2), 0xFF0033FF),
        (np.array([0, 0, 1]), 0x0000FFFF),
    ],
)
def test_every_form_of_a_color(color, packed):
    assert colors.rgba(color).tolist() == [packed]


def test_alpha():
    assert colors.rgba("#000000", 0.5).tolist() == [0x00000080]


@pytest.mark.parametrize("color", ["gren", "#12", "#gggggg", (1, 2, 3), (0.1, 0.2), "#-12345"])
def test_what_is_no_color(color):
    with pytest.raises(ConfigError, match="color"):
        colors.rgba(color)


def test_a_near_name_is_suggested():
    with pytest.raises(ConfigError, match='Did you mean "green"'):
        colors.rgba("gren")


@pytest.mark.parametrize("alpha", [-0.1, 1.5, "half"])
def test_what_is_no_opacity(alpha):
    with pytest.raises(ConfigError, match="alpha"):
        colors.rgba("red", alpha)


def test_colormap_runs_from_first_to_last_color():
    mapped = colors.map_values(np.array([0.0, 1.0, 2.0]), (0.0, 2.0), "gray", 1.0)
    assert mapped.tolist() == [0x000000FF, 0x808080FF, 0xFFFFFFFF]


def test_unknown_colormap():
    with pytest.raises(ConfigError, match="viridis"):
        colors.map_values(np.zeros(2), (0, 1), "viridi", 1.0)


def test_curves_go_round():
    count = len(colors.CURVES)
    assert colors.curves(1)[0] == colors.curves(1, count)[0]
    assert len(set(colors.curves(count).tolist())) == count
