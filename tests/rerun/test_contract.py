"""The visualizer keeps the contract that other visualizers keep."""

import pytest

from physx_core.testing import check_visualizer
from physx_rerun.visualizer import RerunVisualizer


def test_a_recording_passes():
    report = check_visualizer(RerunVisualizer)
    assert report.ok and report.counts()["skipped"] == 1, str(report)


@pytest.mark.usefixtures("vulkan")
def test_pictures_pass():
    report = check_visualizer(lambda: RerunVisualizer(mode="offscreen"))
    assert report.ok and not report.counts()["skipped"], str(report)
