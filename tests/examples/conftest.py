import importlib
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
def module(root, monkeypatch):
    """Import a module of the examples, as their scripts do."""
    monkeypatch.syspath_prepend(root / "examples")
    before = set(sys.modules)
    yield importlib.import_module
    own = {path.stem for path in (root / "examples").iterdir()}
    for name in set(sys.modules) - before:
        if name.partition(".")[0] in own:
            del sys.modules[name]


@pytest.fixture
def run(tmp_path):
    """Run a script in the test's folder, or another one, and return how it ended."""

    def run(*words, cwd=tmp_path):
        return subprocess.run(
            [sys.executable, *map(str, words)],
            cwd=cwd,
            env={"MPLBACKEND": "agg", **os.environ},
            capture_output=True,
            text=True,
            timeout=600,
        )

    return run
