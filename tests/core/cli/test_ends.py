"""How commands end when they are told to: orderly, and with the status that shells expect."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("nothing_stays_behind")
WAYS = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}


def end(words, is_running, number):
    """Start a command, and send it a signal when it runs; return what it wrote to stderr."""
    process = subprocess.Popen(
        [sys.executable, "-m", "physx_core", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, "PHYSX_TOKEN": "a-token-of-this-test"},
        text=True,
    )
    with process:
        deadline = time.monotonic() + 60
        while not is_running():
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.01)
        process.send_signal(number)
        error = process.communicate(timeout=60)[1]
    status, how = WAYS[number]
    assert process.returncode == status, error
    assert f"physx: {how}" in error and "Traceback" not in error
    return error


@pytest.mark.parametrize("number", WAYS)
@pytest.mark.parametrize("options", [[], ["--environment.no-as-tcp-ip-client"]])
def test_a_data_generation(number, options):
    words = ["generate", "toy/spring", "--batch-nb", "1000000", "--batch-size", "10", *options]
    place = Path("sessions/data_generation/dataset")
    end(words, lambda: any(place.glob("*.h5")), number)


@pytest.mark.parametrize("number", WAYS)
def test_a_client(number):
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.0)
        accepted = []

        def is_running():
            try:
                accepted.append(server.accept()[0])
            except BlockingIOError:
                return False
            return True

        end(["client", "--connect", f"127.0.0.1:{server.getsockname()[1]}"], is_running, number)
        for connection in accepted:
            connection.close()


@pytest.mark.parametrize("number", WAYS)
def test_tensorboard(number, port):
    pytest.importorskip("tensorboard")
    Path("session/stats/tensorboard").mkdir(parents=True)

    def is_running():
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    words = ["stats", "session", "--tensorboard", "--port", str(port)]
    error = end(words, is_running, number)
    assert "sample" not in error
