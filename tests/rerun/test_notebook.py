"""Recordings in a notebook; what its widget gets needs the extra to be tested."""

from __future__ import annotations

import importlib.util
import time

import numpy as np
import pytest
from rerun import notebook

from physx_core.components import Factory
from physx_core.errors import MissingLibraryError, VisualizerError
from physx_rerun import show


def test_without_the_extra_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(notebook, "HAS_NOTEBOOK", False)
    with pytest.raises(MissingLibraryError, match=r"rerun-notebook.*physx_rerun\[notebook\]"):
        show(tmp_path)


@pytest.mark.skipif(importlib.util.find_spec("rerun_notebook") is None, reason="needs the extra")
def test_the_widget_gets_the_recording(opened, tmp_path, monkeypatch):
    visualizer, factory = opened(), Factory()
    factory.add_points("cloud", np.zeros((1, 3)))
    visualizer.events(1, 0, factory.take_events())
    visualizer.close()
    received = []
    monkeypatch.setattr(notebook.Viewer, "display", lambda viewer: None)
    monkeypatch.setattr(notebook.Viewer, "_flush_hook", lambda viewer, data: received.append(data))
    show(tmp_path, width=300)
    deadline = time.monotonic() + 60  # Rerun reads the file in a thread of its own
    while not any(b"/env_1/cloud" in data for data in received):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    with pytest.raises(VisualizerError, match="no recording, session or dataset"):
        show(tmp_path / "none")
