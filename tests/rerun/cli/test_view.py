"""physx view: recordings and datasets in a browser; a window needs a display."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
import urllib.parse
import urllib.request

import numpy as np
import psutil
import pytest
import rerun as rr

from physx_core.components import Factory
from physx_core.errors import VisualizerError
from physx_rerun.cli import view
from physx_rerun.viewer.viewer import Viewer

pytestmark = pytest.mark.processes

VIEW = "import sys; from physx_rerun.cli import view; view.run(sys.argv[1:])"


@pytest.fixture
def session(opened, tmp_path):
    visualizer, factory = opened(), Factory()
    factory.add_points("cloud", np.zeros((1, 3)))
    visualizer.events(1, 0, factory.take_events())
    visualizer.close()
    return tmp_path


def test_a_page_for_browsers_until_it_is_interrupted(session, tmp_path):
    command = [sys.executable, "-c", VIEW, session, "--web"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        page, _, viewer = run.stdout.readline().split()[1].partition("?url=")
        children = psutil.Process(run.pid).children(recursive=True)
        with urllib.request.urlopen(page, timeout=30) as answer:
            assert b"<html" in answer.read()
        received = tmp_path / "received.rrd"
        with Viewer(0, (urllib.parse.unquote(viewer), "--save", str(received))).process:
            deadline = time.monotonic() + 60
            while "/env_1/cloud" not in entities_of(received):
                assert time.monotonic() < deadline
                time.sleep(0.1)
        run.send_signal(signal.SIGINT)
        assert run.wait(timeout=60) == 0
    assert children and not any(child.is_running() for child in children)


def entities_of(path):
    try:
        return {chunk.entity_path for chunk in rr.chunk.RrdReader(path).stream()}
    except (FileNotFoundError, ValueError, RuntimeError):  # it is being written
        return set()


def test_without_a_display_the_other_ways_are_named(session, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(VisualizerError, match="no display.*--web.*physx snapshot"):
        view.run([str(session)])


def test_a_window_that_cannot_be_opened(session, monkeypatch):
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":987")
    before = psutil.Process().children(recursive=True)
    with pytest.raises(VisualizerError, match="viewer ended with status"):
        view.run([str(session)])
    assert psutil.Process().children(recursive=True) == before


@pytest.mark.parametrize(
    ("name", "message"), [(".", "neither a recording"), ("none.rrd", "no recording, session or")]
)
def test_nothing_to_view(tmp_path, name, message):
    with pytest.raises(VisualizerError, match=message):
        view.run([str(tmp_path / name)])
