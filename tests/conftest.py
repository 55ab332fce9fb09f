"""What all tests share."""

import os
import signal
import time
import uuid
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# How long an example takes says nothing on a busy machine.
settings.register_profile("physx", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("physx")

# A shell that starts the tests in the background has them ignore Ctrl-C, and every process that
# they start inherits that; some tests press it.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def nothing_stays_behind(monkeypatch):
    """Every process that the test starts, directly or not, is gone when it ends."""
    mark = uuid.uuid4().hex
    monkeypatch.setenv("PHYSX_TEST_MARK", mark)
    yield
    deadline = time.monotonic() + 60  # a process that is killed takes a moment to go
    while (left := marked(mark.encode())) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not left
    with pytest.raises(ChildProcessError):  # nor is there one that nobody waited for
        os.waitpid(-1, os.WNOHANG)


def marked(mark):
    """Command lines of the other processes with a mark in their environment."""
    found = []
    for environ in Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark in environ.read_bytes() and int(environ.parent.name) != os.getpid():
                found.append((environ.parent / "cmdline").read_bytes())
        except OSError:
            continue
    return found
