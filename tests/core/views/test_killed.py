"""Trainings on views that are killed within epochs, while samples are added to their data."""

import sys
from pathlib import Path

import numpy as np
import pytest
from sizes import trials

from physx_core import Dataset, checkpoint

PROGRAMS = Path(__file__).parents[1] / "programs"
PROGRAM = PROGRAMS / "view_run.py"
pytestmark = [pytest.mark.faults, pytest.mark.processes]


@pytest.fixture
def views(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(PROGRAMS), *sys.path])
    import view_run

    for folder, count in (("a", 40), ("b", 20)):
        view_run.store(folder, count)


@pytest.mark.parametrize("view", ["folds", "test_fold", "mixture", "weights"])
@pytest.mark.reported(
    "pytorch-lightning#19764",
    "pytorch-lightning#18780",
    "pytorch-lightning#2530",
    "pytorch-lightning#1182",
    "litData#775",
    "datasets#7901",
    "streaming#880",
    about="a resumed training repeats samples or leaves some out",
)
def test_a_killed_training_on_a_view_resumes_bit_identically(view, run_killed, views):
    _, whole = run_killed(str(PROGRAM), Path.cwd(), [], "whole", view)
    random = np.random.default_rng(sum(view.encode()))
    moments = (whole * random.uniform(0.3, 0.9, trials(20, 2))).tolist()
    run_killed(str(PROGRAM), Path.cwd(), moments, "killed", view)
    found, wanted = (checkpoint.find(Path("sessions", n), None, -1) for n in ("killed", "whole"))
    for name in ("parameters.npz", "normalization.npz"):
        if (wanted.path / name).exists():
            assert (found.path / name).read_bytes() == (wanted.path / name).read_bytes()
    assert (wanted.path / "parameters.npz").exists()
    assert found.progress.last_batch == wanted.progress.last_batch != {}
    assert found.progress.snapshots == wanted.progress.snapshots
    assert found.progress.record == wanted.progress.record
    with Dataset.open("a") as dataset:
        assert dataset.verify() == []
