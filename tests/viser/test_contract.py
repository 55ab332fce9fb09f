"""The visualizer keeps the contract that other visualizers keep."""

import pytest

from physx_testing import check_visualizer
from physx_viser import ViserVisualizer

pytestmark = pytest.mark.processes


def test_the_visualizer_keeps_the_contract():
    report = check_visualizer(ViserVisualizer)
    assert report.ok, str(report)
