"""The visualizer keeps the contract that other visualizers keep."""

import pytest

from physx_rerun.visualizer import RerunVisualizer
from physx_testing import check_visualizer

pytestmark = pytest.mark.processes


def test_the_visualizer_keeps_the_contract():
    report = check_visualizer(RerunVisualizer)
    assert report.ok and report.counts()["skipped"] == 1, str(report)
