"""Each kind of process that physx starts ends with whoever started it, in each way to end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.processes

OWNER = Path(__file__).parent / "programs" / "owner.py"
KINDS = {
    "clients": b"physx_core.workers",
    "vector": b"physx_gym.vector.worker",
    "batches": b"physx_dart.batch.worker",
    "pictures": b"--headless",
    "headless": b"--headless",
    "tensorboard": b"tensorboard.main",
}
"""Kind of process to a part of its command line."""
WAYS = {
    "return": {0},
    "exception": {1},
    "sys.exit": {3},
    "SIGTERM": {-signal.SIGTERM, 128 + signal.SIGTERM},
    "SIGKILL": {-signal.SIGKILL},
    "os._exit": {4},
}
"""Way to end to exit statuses."""
QUICK = {("clients", "SIGTERM"), *((kind, "SIGKILL") for kind in KINDS)}
TIME = 3.0


def marked(mark):
    """Return the command lines of the processes with a mark in their environment."""
    found = []
    for environ in (folder / "environ" for folder in Path("/proc").glob("[0-9]*")):
        try:
            if mark.encode() in environ.read_bytes():
                found.append((environ.parent / "cmdline").read_bytes())
        except OSError:
            continue
    return found


@pytest.mark.parametrize(
    ("kind", "way"),
    [
        pytest.param(kind, way, marks=[] if (kind, way) in QUICK else pytest.mark.faults)
        for kind in KINDS
        for way in WAYS
    ],
)
def test_no_process_and_no_file_is_left(kind, way, tmp_path):
    mark = f"{kind} {way} {tmp_path}"
    files = tmp_path / "temporary"
    files.mkdir()
    owner = subprocess.Popen(
        [sys.executable, str(OWNER), kind, way],
        cwd=tmp_path,
        env={**os.environ, "PHYSX_TEST_MARK": mark, "TMPDIR": str(files)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=(tmp_path / "stderr").open("wb"),
        text=True,
    )
    with owner:
        try:
            answer = owner.stdout.readline()
            if answer.startswith("skip") and "Vulkan" in answer and os.environ.get("CI") != "true":
                pytest.skip(answer)
            assert answer == "ready\n", (answer, (tmp_path / "stderr").read_text())
            assert any(KINDS[kind] in command for command in marked(mark))
            owner.stdin.close()
            status = owner.wait(60)
        finally:
            owner.kill()
    began = time.monotonic()
    limit = TIME * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))  # others compute, too
    while left := [*marked(mark), *files.iterdir()]:
        assert time.monotonic() < began + limit, left
        time.sleep(0.02)
    assert status in WAYS[way]
