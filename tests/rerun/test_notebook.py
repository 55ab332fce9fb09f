"""Recordings in a notebook; what its widget gets needs the extra to be tested."""

from __future__ import annotations

import importlib.util
import time

import numpy as np
import pytest
from rerun import notebook

from physx_core import Dataset
from physx_core.components import Factory
from physx_core.errors import DatasetError, MissingLibraryError, VisualizerError
from physx_rerun import show

pytestmark = pytest.mark.processes


@pytest.fixture
def in_notebook(monkeypatch):
    monkeypatch.setattr("physx_rerun.notebook.in_notebook", lambda: True)


@pytest.fixture
def dataset(tmp_path):
    with Dataset.create(tmp_path / "data") as dataset:
        dataset.append("training", {"x": np.arange(8.0).reshape(4, 2)})
        yield dataset


@pytest.mark.usefixtures("in_notebook")
def test_without_the_extra_and_a_driver_the_remedy_is_named(dataset, monkeypatch):
    monkeypatch.setattr(notebook, "HAS_NOTEBOOK", False)
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, "nowhere.json")
    with pytest.raises(MissingLibraryError, match=r"rerun-notebook.*physx_rerun\[notebook\]"):
        dataset.show()


@pytest.mark.usefixtures("in_notebook", "vulkan")
def test_without_the_extra_a_row_is_a_picture(dataset, monkeypatch):
    shown = []
    monkeypatch.setattr(notebook, "HAS_NOTEBOOK", False)
    monkeypatch.setattr("IPython.display.display", shown.append)
    dataset.show(row=2)
    assert shown[0].data.startswith(b"\x89PNG")


@pytest.mark.usefixtures("vulkan")
def test_in_a_script_the_path_of_a_picture_is_printed(dataset, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    dataset.show(row=2)
    assert capsys.readouterr().out == "picture: data.png\n" and (tmp_path / "data.png").is_file()


def test_a_row_that_does_not_exist_is_an_error(dataset):
    with pytest.raises(DatasetError, match="has no row 4: it has 4, from 0"):
        dataset.show(row=4)


@pytest.mark.usefixtures("in_notebook")
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
