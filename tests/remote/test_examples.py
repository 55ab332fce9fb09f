"""The examples of environments in other processes run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("physx_dart", reason="the examples run on DART")

EXAMPLES = Path(__file__).parents[2] / "examples"
PATIENCE = 120.0


def run(name, *words):
    command = [sys.executable, str(EXAMPLES / name / "run.py"), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_apples_are_found():
    text = run("apple_seeker", "--small")
    assert "of 5 apples" in text and "0 apples in" not in text


def test_a_pole_is_balanced_and_put_back():
    text = run("remote_cartpole")
    assert "The pole stood for" in text and "Back at the begin: [" in text
