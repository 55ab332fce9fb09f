"""The cursor of an open viewer, from which a branch begins."""

from __future__ import annotations

import time

import pytest
from rerun.experimental import ViewerClient

from physx_core import DataGeneration, EnvironmentConfig
from physx_core.cli import main
from physx_core.errors import VisualizerError
from physx_core.results import read_results
from physx_rerun import RerunVisualizer
from physx_rerun.recordings import recording_of
from physx_rerun.viewer import cursor
from physx_rerun.viewer.headless import Camera
from physx_rerun.viewer.viewer import Viewer, find_free_port

pytestmark = pytest.mark.processes


@pytest.fixture
def port(monkeypatch):
    """A port that is used instead of the usual one."""
    found = find_free_port()
    for module in ("physx_rerun.viewer.cursor", "physx_rerun.visualizer"):
        monkeypatch.setattr(f"{module}.USUAL_PORT", found)
    return found


@pytest.mark.usefixtures("vulkan")
def test_a_branch_begins_at_the_cursor_and_is_drawn_in_the_same_viewer(
    port, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    environment = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=0)
    with DataGeneration(environment, batch_nb=1, batch_size=40, quiet=True) as run:
        run.execute()
    data = str(run.session.path)
    with recording_of(data) as recording:
        options = "--headless", "--window-size", "320x240", str(recording)
        viewer = Viewer(port, options)
        try:
            viewer.wait_until_ready()
            camera = Camera(viewer, time.monotonic() + 60)
            camera.wait_for_recording()
            camera.go_to("row", 23)
            assert RerunVisualizer.cursor().position == 23
            words = ["branch", data, "cursor", "--set", "stiffness=5", "--step-nb", "30"]
            assert main(words) == 0
            assert "row 23 of training" in capsys.readouterr().err
            assert read_results("sessions/branch")["branch"]["difference/state/rmse"] > 0
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            while len(client.get_state().recordings) < 2:
                assert time.monotonic() < camera.deadline
                time.sleep(0.05)
        finally:
            viewer.end()


def test_a_viewer_that_is_not_there_is_named():
    with pytest.raises(VisualizerError, match="physx view DATASET --live"):
        cursor.find_cursor(f"127.0.0.1:{find_free_port()}")
