"""A trainer of plain bytes, and an environment that has everything."""

from __future__ import annotations

import json
import select
import socket
import struct
import time
from pathlib import Path

import pytest

from physx_core.plugins import find
from physx_remote import Worlds
from physx_remote.godot_rl.protocol import GodotRL


class Trainer:
    """The side that listens; the service runs in the same thread, while an answer is awaited."""

    def __init__(self, worlds, **options):
        with socket.create_server(("127.0.0.1", 0)) as listener:
            port = listener.getsockname()[1]
            self.service = GodotRL(**options).service(worlds, address="127.0.0.1", port=port)
            self.socket, _ = listener.accept()
        assert self.service.address == ("127.0.0.1", port)

    @staticmethod
    def framed(message):
        body = message if isinstance(message, bytes) else json.dumps(message).encode()
        return struct.pack("<I", len(body)) + body

    def send(self, message):
        self.socket.sendall(self.framed(message))

    def ask(self, message):
        self.send(message)
        return self.answer()

    def answer(self):
        body = self.take(struct.unpack("<I", self.take(4))[0])
        return json.loads(body)

    def take(self, size):
        taken = b""
        deadline = time.monotonic() + 60
        while len(taken) < size:
            if not select.select([self.socket], [], [], 0)[0]:
                assert time.monotonic() < deadline, "no answer"
                self.service.poll(0.05)
                continue
            piece = self.socket.recv(size - len(taken))
            assert piece, "the service closed the connection"
            taken += piece
        return taken

    def is_silent(self):
        """Return whether nothing comes after all that was sent has been handled."""
        for _ in range(5):
            self.service.poll(0.01)
        return not select.select([self.socket], [], [], 0)[0]

    def service_ends(self):
        deadline = time.monotonic() + 60
        while self.service.poll(0.05):
            if time.monotonic() > deadline:
                return False
        return True

    def close(self):
        self.socket.close()
        self.service.close()


@pytest.fixture
def cart():
    return find("environment", f"{Path(__file__).with_name('envs.py')}:Cart")


@pytest.fixture
def trainer(cart):
    made = []

    def make(worlds=None, num=1, options=None, **arguments):
        worlds = worlds or Worlds([cart(**arguments) for _ in range(num)])
        made.append(Trainer(worlds, **(options or {})))
        return made[-1]

    yield make
    for one in made:
        one.close()
