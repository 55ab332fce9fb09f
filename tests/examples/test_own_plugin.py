"""The viewer of examples/05_own_plugin, as its README uses it: by its file, and installed."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import run_pages
from PIL import Image

pytestmark = [pytest.mark.slow, pytest.mark.processes]

pytest.importorskip("matplotlib")


@pytest.fixture
def blocks(root, tmp_path):
    """The two blocks of the README; the folder of the examples is where they are run."""
    (tmp_path / "examples").symlink_to(root / "examples")
    return [each.text for each in run_pages.read(root / "examples/05_own_plugin/README.md")]


def run(command, folder, **environment):
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    words = ["/bin/sh", "-e", "-c", command]
    environment = {**os.environ, "PATH": path, "PYTHONPATH": "", **environment}
    done = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def colors(folder):
    [picture] = folder.glob("sessions/*/*.png")
    with Image.open(picture) as image:
        return len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0))


def test_it_is_used_by_the_name_of_its_file(blocks, tmp_path):
    assert "picture: " in run(blocks[0], tmp_path)
    assert colors(tmp_path) > 100


def test_it_is_installed_checked_and_used_by_its_name(blocks, tmp_path):
    install, check, generate = blocks[1].splitlines()
    quick = f"--quiet --no-deps --no-build-isolation --target {tmp_path / 'packages'}"
    run(f"{sys.executable} -m {install} {quick}", tmp_path)
    found = {"PYTHONPATH": str(tmp_path / "packages")}
    assert "passed" in run(check, tmp_path, **found)
    assert "picture: " in run(generate, tmp_path, **found)
    assert colors(tmp_path) > 100
