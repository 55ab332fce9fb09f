"""MuJoCo is selected by name, and makes what the other engines make."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from physx_core import Dataset

pytestmark = pytest.mark.processes

pytest.importorskip("mujoco")


@pytest.mark.slow
def test_an_environment_generates_samples_with_it_in_clients(tmp_path):
    pytest.importorskip("gymnasium")
    words = ("generate", "gym/physx/Cartpole-v0", "--environment.env-kwargs")
    sizes = ("--batch-nb", "3", "--batch-size", "20", "--environment.num-clients", "2")
    rows = {}
    for engine in ("mujoco", "dart"):
        options = (f"backend={engine}", *sizes, "--environment.seed", "1")
        command = [sys.executable, "-m", "physx_core", *words, *options, "--session-name", engine]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, timeout=300)
        with Dataset.open(tmp_path / "sessions" / engine / "dataset") as dataset:
            mode = dataset["training"]
            rows[engine] = {name: mode[name][:] for name in dataset.fields("training")}
    assert rows["mujoco"].keys() == rows["dart"].keys()
    for name, values in rows["mujoco"].items():
        assert len(values) == 60
        np.testing.assert_allclose(values, rows["dart"][name], rtol=1e-6, atol=1e-6, err_msg=name)
