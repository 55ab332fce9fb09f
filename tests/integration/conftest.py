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
    """Run a command in the test's folder and return what it printed; it must succeed."""

    def run(*words, python=sys.executable, ok=True, **environment):
        done = subprocess.run(
            [str(python), *map(str, words)],
            cwd=tmp_path,
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            timeout=600,
        )
        if ok:
            assert done.returncode == 0, done.stdout + done.stderr
        return done

    return run


def processes_with(text):
    """Return the command lines of all processes that contain a text, this one left out."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            environment = (entry / "environ").read_bytes().decode(errors="replace")
        except (OSError, UnicodeDecodeError):
            continue
        if state != "Z" and text in command + environment:
            found.append(command)
    return found


@pytest.fixture
def processes():
    return processes_with
