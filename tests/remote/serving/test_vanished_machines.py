"""Services and clients whose other side is unplugged: places are free, and waits end, within 20 s.

All of them lose the same cable at once, because each needs those seconds.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from physx_remote import connect
from physx_remote.errors import RemoteError

pytestmark = pytest.mark.processes

PROGRAMS = Path(__file__).parents[1] / "programs"
SLOW = f"{PROGRAMS / 'slow_env.py'}:Slow"
TOKEN = "a token for these tests"
SOON = 20.0
LONG = 120.0
PORT = 11008


@pytest.fixture
def start(monkeypatch, nothing_stays_behind):
    """Start a Python program, and end it with the test."""
    monkeypatch.setenv("PHYSX_TOKEN", TOKEN)
    with contextlib.ExitStack() as stack:

        def start(*words, prefix=()):
            process = subprocess.Popen(
                [*prefix, sys.executable, *words],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            stack.enter_context(process)
            stack.callback(process.kill)
            watchdog = threading.Timer(LONG, process.kill)
            watchdog.start()
            stack.callback(watchdog.cancel)
            return process

        yield start


@pytest.fixture
def serve(start, another_machine):
    """Start ``physx serve``."""

    def serve(protocol, address, port=0):
        words = ["serve", SLOW, "--protocol", protocol, "--address", address, "--port", str(port)]
        return start("-m", "physx_core", *words)

    return serve


@pytest.fixture
def far(start, another_machine):
    """Start a client on the other machine."""

    def far(*words):
        program = str(PROGRAMS / "far_client.py")
        return start(program, *words, prefix=another_machine.prefix)

    return far


def line_with(text, process):
    """Return the next line of a program that holds a text."""
    return next(line for line in process.stdout if text in line)


def next_client(protocol, address):
    """Return when the next client was served."""
    while True:
        try:
            with contextlib.closing(connect(address, protocol)) as env:
                env.reset()
                env.step(env.action_space.low)
                return time.monotonic()
        except RemoteError as error:
            if "acts here already" not in str(error):
                raise
            time.sleep(0.2)


@pytest.mark.slow
@pytest.mark.faults
def test_network_loss_frees_slot_of_client(serve, far, another_machine):
    each = [(p, what) for p in ("physx", "godot-gym") for what in ("idle", "busy", "waiting")]
    services = {one: serve(one[0], another_machine.address) for one in each}
    address = {
        one: line_with("listening", service).split()[-1] for one, service in services.items()
    }
    clients = {one: far(one[0], address[one], one[1]) for one in each}
    trainer = far("godot-rl", f"0.0.0.0:{PORT}", "busy")
    application = serve("godot-rl", another_machine.own, PORT)
    for client in (*clients.values(), trainer):
        line_with("ready", client)
    another_machine.unplug()
    pulled = time.monotonic()
    with ThreadPoolExecutor(len(each) * 2) as pool:
        # A service that is in a step of minutes serves the next one afterwards.
        served = {
            one: pool.submit(next_client, one[0], address[one])
            for one in each
            if one[1] != "waiting"
        }
        ended = {
            one: pool.submit(line_with, "Error", clients[one]) for one in each if one[1] != "idle"
        }
        ended["trainer"] = pool.submit(line_with, "Error", trainer)
        ended["application"] = pool.submit(line_with, "Error", application)
        for one, line in ended.items():
            assert "no longer answers" in line.result(LONG), one
        assert time.monotonic() - pulled < SOON
        for one, moment in served.items():
            assert moment.result(LONG) - pulled < SOON, one
    assert application.wait(LONG) == 1
