"""The sweep of the examples runs by the commands that it says, and draws a figure."""

import subprocess
import sys

import gallery
import numpy as np
import pytest
from PIL import Image

pytestmark = [pytest.mark.faults, pytest.mark.processes]

pytest.importorskip("torch")
pytest.importorskip("optuna")
pytest.importorskip("matplotlib")

SMALLER = {
    "trials = 4": "trials = 2",
    "batch = 2": "batch = 1",
    "seeds = [0, 1]": "seeds = [0]",
    "epoch_nb = 10": "epoch_nb = 1",
}


def test_the_commands_of_the_sweep_make_a_table_and_a_figure(tmp_path):
    definition = (gallery.EXAMPLES / "19_sweep.toml").read_text()
    for full, small in SMALLER.items():
        assert full in definition
        definition = definition.replace(full, small)
    (tmp_path / "19_sweep.toml").write_text(definition)
    (tmp_path / "environments").symlink_to(gallery.EXAMPLES / "environments")
    for command in gallery.commands("19_sweep").replace("examples/", "").splitlines():
        words = command.replace("--batch-size 2000", "--batch-size 200").split()
        done = subprocess.run(
            [sys.executable, "-m", "physx_core.cli", *words[1:]],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert words[0] == "physx" and done.returncode == 0, done.stderr
        if "--status" in words:
            assert done.stdout.count("complete") >= 3
    with Image.open(tmp_path / "sweep.png") as figure:
        assert len(np.unique(np.asarray(figure.convert("RGB")).reshape(-1, 3), axis=0)) > 16
