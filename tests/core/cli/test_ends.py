"""How commands end when they are told to: orderly, and with the status that shells expect."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.request import urlopen

import pytest

from physx_core import Dataset
from physx_core.cli import main
from physx_core.errors import DatasetError

pytestmark = [pytest.mark.usefixtures("nothing_stays_behind"), pytest.mark.processes]
WAYS = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}


def end(words, is_running, number, is_ending=None):
    """Start a command, send it a signal when it runs, and another one when it is ending.

    Return what it wrote to stderr.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "physx_core", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, "PHYSX_TOKEN": "a-token-of-this-test"},
        text=True,
    )
    with process:
        for condition in filter(None, (is_running, is_ending)):
            deadline = time.monotonic() + 60
            while not condition():
                assert process.poll() is None, process.stderr.read()
                assert time.monotonic() < deadline
                time.sleep(0.01)
            if condition is is_ending:
                time.sleep(0.6)  # what comes sooner is the first one again
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


ENVIRONMENT = """
import time
from pathlib import Path
import numpy as np
from physx_core import Environment

class Slow(Environment):
    def create(self):
        pass
    def init_database(self):
        self.define_training_fields([("x", np.ndarray)])
    def step(self):
        self.set_training_data(x=np.ones(1))

class SlowToClose(Slow):
    def close(self):
        Path("closing").touch()
        time.sleep(60)

class Converts(Slow):
    def step(self):
        try:
            Path("stepping").touch()
            time.sleep(60)
        except BaseException:
            raise KeyError("what an import makes of it") from None
"""


@pytest.mark.parametrize("options", [[], ["--environment.no-as-tcp-ip-client"]])
def test_a_second_sigterm_ends_what_takes_long_to_close_and_keeps_the_rows(options):
    Path("slow.py").write_text(ENVIRONMENT)
    place = Path("sessions/data_generation/dataset")

    def rows():
        try:
            with Dataset.open(place) as dataset:
                return dataset.num_samples("training")
        except DatasetError:
            return 0

    words = ["generate", "slow.py:SlowToClose", "--batch-nb", "100000000", "--batch-size", "1"]
    end([*words, *options], rows, signal.SIGTERM, Path("closing").exists)
    kept = rows()
    assert main(["verify", str(place), "--repair"]) == main(["verify", str(place)]) == 0
    assert rows() == kept > 0


def test_an_error_that_sigterm_became_does_not_change_the_status():
    Path("slow.py").write_text(ENVIRONMENT)
    words = ["generate", "slow.py:Converts", "--environment.no-as-tcp-ip-client"]
    options = ["--batch-nb", "1", "--batch-size", "1"]
    error = end([*words, *options], Path("stepping").exists, signal.SIGTERM)
    assert "what an import makes of it" in error


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
        try:  # it listens before it has started
            return urlopen(f"http://127.0.0.1:{port}/data/logdir", timeout=5).status == 200
        except OSError:
            return False

    words = ["stats", "session", "--tensorboard", "--port", str(port)]
    error = end(words, is_running, number)
    assert "sample" not in error
