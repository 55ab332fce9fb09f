"""What several files share: clients that people start, and the rows of a run."""

from __future__ import annotations

import contextlib
import subprocess
import sys

import numpy as np
import pytest

TOKEN = "a token for these tests"
CLIENT = [sys.executable, "-m", "physx_core", "client"]


@pytest.fixture
def token(monkeypatch):
    monkeypatch.setenv("PHYSX_TOKEN", TOKEN)


@pytest.fixture
def by_hand(clients, token, port):
    """Return a source that waits at the port for clients that know the token."""

    def make(environment="Plain", **options):
        options = {"launcher": "physx/manual", "port": port, "timeout": 20.0, **options}
        return clients(environment, **options)

    return make


@pytest.fixture
def join(port, token, nothing_stays_behind):
    """Return a function that starts ``physx client`` for the port."""
    with contextlib.ExitStack() as stack:

        def start(*words, prefix=(), address=f"127.0.0.1:{port}", **options):
            process = subprocess.Popen(
                [*prefix, *CLIENT, "--connect", address, *words],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                **options,
            )
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        yield start


class Rows:
    """Rows that are taken from a source."""

    def __init__(self, source):
        self._source, self._parts = source, []

    def take(self, *sizes):
        """Take batches of these sizes."""
        for size in sizes:
            batch = self._source.batch(size)
            self._parts.append({name: values.copy() for name, values in batch.items()})

    def check(self, source):
        """Check that another source makes the same rows, to the last bit."""
        count = sum(len(part["step"]) for part in self._parts)
        with source:
            expected = source.batch(count)
            for name, values in expected.items():
                found = np.concatenate([part[name] for part in self._parts])
                assert found.tobytes() == values.tobytes(), name


@pytest.fixture
def taking():
    """Return the rows that are taken from a source."""
    return Rows
