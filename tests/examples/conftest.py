import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def root():
    """The repository."""
    return ROOT


@pytest.fixture
def run(tmp_path):
    """Run a script in the test's folder, or another one, and return how it ended."""

    def run(*words, cwd=tmp_path):
        return subprocess.run(
            [sys.executable, *map(str, words)],
            cwd=cwd,
            env={"OMP_NUM_THREADS": "1", "MPLBACKEND": "agg", **os.environ},
            capture_output=True,
            text=True,
            timeout=600,
        )

    return run
