"""What several files share: scenes that count what happens, and peers that speak in plain bytes."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import threading

import numpy as np
import pytest

from physx_core import Field
from physx_remote import Messages, RLAgent, RLEnvironment, RLEnvWorld, connect, serve
from physx_remote.godot_gym.messages import ERROR, fill, read_extension

PATIENCE = 30.0


def framed(body):
    body = json.dumps(body).encode() if not isinstance(body, bytes) else body
    return struct.pack("<I", len(body)) + body


class Walker(RLAgent):
    """Goes on by four times its action in each physics frame, and keeps what it was told."""

    def __init__(self, calls):
        self.calls, self.distance, self.action, self.frames = calls, 0.0, 0.0, 0

    def set_action(self, action):
        self.calls.append(("set_action", action))
        self.action = action[0] if isinstance(action, list) and action else 0.0

    def get_data(self, request, storage):
        self.calls.append(("agent.get_data", request))
        fill(storage, a=[self.distance])

    def reset(self, arguments=None):
        self.distance = 0.0

    def configure(self, configuration):
        self.calls.append(("agent.configure", configuration))

    def _physics_process(self, delta):
        self.frames += 1
        self.distance += 4 * self.action


class Room(RLEnvWorld):
    def __init__(self, calls):
        self.calls = calls

    def get_data(self, request, storage):
        self.calls.append(("world.get_data", request))
        fill(storage, done=True, big=-1)

    def configure(self, configuration):
        self.calls.append(("world.configure", configuration))


class Scene(RLEnvironment):
    """An agent that walks in a room; `calls` holds what was called, in order."""

    def __init__(self):
        super().__init__()
        self.calls = []

    def _ready(self):
        self.agent, self.world = Walker(self.calls), Room(self.calls)
        self.messages = Messages.of_fields(
            agent=[Field("a", dtype="float32"), ("frame", bytes), Field("d")],
            world=[("done", bool), ("big", int)],
        )

    def _reset(self):
        self.calls.append(("reset", self.reset_request))
        self.agent.reset()

    def _after_send_response(self):
        self.calls.append(("after", None))


class Peer:
    """A client of plain bytes; while it waits it has the service work, unless a thread does."""

    def __init__(self, address, service=None):
        self.socket = socket.create_connection(address, PATIENCE)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.service, self.received = service, b""

    def send(self, data):
        self.socket.sendall(data)

    def arrive(self):
        """Have the service handle what has arrived by now, and take what it sent."""
        for _ in range(3):
            self.service.poll(0.0)
            self.received += self.there() or b""

    def there(self):
        """Return what has arrived, None for nothing yet."""
        self.socket.setblocking(False)
        try:
            return self.socket.recv(65536)
        except BlockingIOError:
            return None
        finally:
            self.socket.settimeout(PATIENCE)

    def read(self, count):
        """Return so many bytes, or what there was before the end."""
        while len(self.received) < count:
            data = self.socket.recv(65536) if self.service is None else self.there()
            if data is None:
                self.service.poll(0.05)
                continue
            if not data:
                break
            self.received += data
        taken, self.received = self.received[:count], self.received[count:]
        return taken

    def answer(self):
        """Return the body of the next answer, None at the end of the connection."""
        prefix = self.read(4)
        return self.read(struct.unpack("<I", prefix)[0]) if len(prefix) == 4 else None

    def ask(self, request):
        self.send(framed(request))
        return self.answer()

    def error(self, request):
        """Return the error with which a request is answered."""
        return read_extension(self.ask(request), ERROR)

    def leave(self, how="fin"):
        if how == "rst":
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()


class OriginalClient:
    """Behaves as the client of godot_gym_api does: waits for each answer, reads a prefix once."""

    def __init__(self, messages, address):
        self.messages = messages
        self.socket = socket.create_connection(address)

    def request(self, request):
        self.socket.sendall(framed(request))
        length = struct.unpack("<I", self.socket.recv(4))[0]
        body = b""
        while len(body) < length:
            body += self.socket.recv(min(65536, length - len(body)))
        message = self.messages.Message()
        message.ParseFromString(body)
        return {"agent": message.agent_data, "world": message.world_data}

    def configure(self, config):
        self.request({"config": config})

    def step(self, action, requested):
        return self.request({"action": action, "observation": requested})

    def reset(self, requested):
        return self.request({"reset": True, "observation": requested})


@pytest.fixture
def start():
    """Serve an environment over godot-gym; the test has it work by `Peer`, or by `poll`."""
    with contextlib.ExitStack() as stack:

        def start(environment, **options):
            return stack.enter_context(serve(environment, "godot-gym", **options))

        yield start


@pytest.fixture
def in_thread(start):
    """Serve an environment over godot-gym in a thread."""
    threads = []

    def in_thread(environment, **options):
        service = start(environment, **options)
        threads.append((service, threading.Thread(target=service.run)))
        threads[-1][1].start()
        return service

    yield in_thread
    for service, thread in threads:
        service.close()
        thread.join(PATIENCE)
        assert not thread.is_alive()


@pytest.fixture
def serving():
    """Serve an environment over physx in a thread, which is the service's `thread`."""
    with contextlib.ExitStack() as stack:

        def serving(environment, token="0123456789abcdef", **options):
            service = serve(environment, "physx", token=token, **options)
            service.thread = threading.Thread(target=service.run)
            service.thread.start()
            stack.callback(service.thread.join, PATIENCE)
            stack.callback(service.close)
            return service

        yield serving


@pytest.fixture
def scene():
    return Scene()


@pytest.fixture
def peer(start, scene):
    """A client of the scene, and `peer.service`."""
    service = start(scene)
    peer = Peer(service.address, service)
    yield peer
    peer.leave()


@pytest.fixture
def scene_class():
    return Scene


@pytest.fixture
def peer_class():
    return Peer


@pytest.fixture
def original_client():
    return OriginalClient


@pytest.fixture
def message():
    """Return a request as it goes over the wire."""
    return framed


@pytest.fixture
def drive(in_thread):
    """Serve an environment in a thread and return a client of it."""
    clients = []

    def drive(environment, protocol_options=None, **options):
        service = in_thread(environment, **(protocol_options or {}))
        host, port = service.address
        clients.append(connect(f"{host}:{port}", "godot-gym", **options))
        return clients[-1]

    yield drive
    for client in clients:
        client.close()


@pytest.fixture
def same():
    return _same


def _same(first, second):
    """Return whether two values are the same in structure, type and every bit."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(_same(first[k], second[k]) for k in first)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(_same, first, second))
    first, second = np.asarray(first), np.asarray(second)
    return first.dtype == second.dtype and np.array_equal(first, second)
