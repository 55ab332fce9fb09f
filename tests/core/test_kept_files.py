"""Files that released versions have written are read, trained on, and gone on with."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from physx_core import Dataset
from physx_core.cli import main
from physx_core.pipelines import Branch

pytestmark = pytest.mark.processes

KEPT = Path(__file__).parent / "kept"


@pytest.fixture(params=sorted(each.name for each in KEPT.iterdir()))
def kept(request, tmp_path, monkeypatch):
    """Digests of what a version stored in sessions, of which there are copies here."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(KEPT / request.param, "sessions")
    return json.loads(Path("sessions/digests.json").read_text())


def digests(rows=None):
    with Dataset.open("sessions/streams") as dataset:
        assert dataset.verify() == []
        return {
            name: hashlib.sha256(np.asarray(dataset["training"][name][:rows]).tobytes()).hexdigest()
            for name in dataset["training"]
        }


def test_rows_are_those_that_were_stored(kept):
    assert digests() == kept


def test_streams_go_on_from_their_states(kept):
    assert main(["generate", "sessions/streams", "--resume", "--batch-nb", "6"]) == 0
    assert digests(40) == kept
    with Dataset.open("sessions/streams") as dataset:
        assert dataset.num_samples("training") == 60


def test_a_row_can_be_branched_off(kept):
    branch = Branch("sessions/streams", 30, {"stiffness": 3.0}, step_nb=4, quiet=True)
    branch.execute()
    assert branch.rows_equal[1] == 4


def test_a_network_predicts_and_is_trained_further(kept):
    assert main(["predict", "sessions/network", "toy/spring", "--step-nb", "3"]) == 0
    assert main(["train", "sessions/network", "--resume", "--epoch-nb", "4"]) == 0
    assert Path("sessions/network/network/network_1").exists()
