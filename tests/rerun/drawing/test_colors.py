from __future__ import annotations

import numpy as np
import pytest

from physx_rerun.drawing import colors


@pytest.mark.parametrize(
    ("color", "alpha", "packed"),
    [("#ff8000", 1.0, 0xFF8000FF), ("black", 0.5, 0x00000080), ((1, 0, 0.2), 1.0, 0xFF0033FF)],
)
def test_colors_are_packed(color, alpha, packed):
    assert colors.rgba(color, alpha).tolist() == [packed]


def test_values_are_packed():
    mapped = colors.map_values(np.array([0.0, 1.0, 2.0]), (0.0, 2.0), "gray", 0.5)
    assert mapped.tolist() == [0x00000080, 0x80808080, 0xFFFFFF80]


def test_curves_go_round():
    count = len(colors.CURVES)
    assert colors.curves(1)[0] == colors.curves(1, count)[0]
    assert len(set(colors.curves(count).tolist())) == count
