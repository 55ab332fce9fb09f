"""Python processes that are connected by a socket pair."""

import os
import signal
import subprocess
from pathlib import Path

import pytest

from physx_core.processes import WorkerProcess

pytestmark = pytest.mark.processes

ECHO = """
import socket, sys
with socket.socket(fileno=int(sys.argv[1])) as link:
    while text := link.recv(100):
        if text == b"end":
            sys.exit("no more")
        link.sendall(text + sys.argv[2].encode())
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "echo_module.py").write_text(ECHO)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "echo_module"


def test_a_worker_talks_over_its_link(module):
    with WorkerProcess(module, "!") as process:
        process.link.sendall(b"hello")
        assert process.link.recv(100) == b"hello!"
        assert process.exit_status() is None
    assert process.exit_status() == -signal.SIGKILL and process.link.fileno() == -1


def test_its_end_is_described_with_its_last_lines(module):
    with WorkerProcess(module, "!") as process:
        process.link.sendall(b"end")
        assert process.link.recv(100) == b""
        assert process.describe_end() == "ended with exit status 1"
        assert process.stderr() == "no more"
    with WorkerProcess(module, "!") as process:
        process.send_signal(signal.SIGKILL)
        assert process.describe_end() == "was killed by signal 9 (SIGKILL)"


def test_a_worker_that_still_runs_only_closed_its_link(module):
    with WorkerProcess(module, "!") as process:
        process.send_signal(signal.SIGSTOP)
        assert process.describe_end(0.01) == "closed its link"


def test_it_shares_descriptors_and_gets_variables(tmp_path, monkeypatch):
    code = "import os, sys; os.write(int(sys.argv[2]), os.environ['WHAT'].encode())"
    (tmp_path / "writer_module.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    readable, writable = os.pipe()
    given = {"pass_fds": [writable], "variables": {"WHAT": "x"}, "stdout": subprocess.DEVNULL}
    with WorkerProcess("writer_module", writable, **given) as process:
        os.close(writable)
        assert os.read(readable, 10) == b"x" and process.wait(10.0) == 0
    os.close(readable)


def test_a_failed_start_leaves_no_descriptor_open(monkeypatch):
    before = len([*Path("/proc/self/fd").iterdir()])
    monkeypatch.setattr("sys.executable", "/there/is/no/python")
    with pytest.raises(OSError, match="no such program"):
        WorkerProcess("module")
    assert len([*Path("/proc/self/fd").iterdir()]) == before
