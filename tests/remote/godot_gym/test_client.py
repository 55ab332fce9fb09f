"""The clients of godot-gym: what they need to know, and what they say when things go wrong."""

from __future__ import annotations

import socket
import struct
import threading

import numpy as np
import pytest
from gymnasium import spaces

from physx_core import Field
from physx_core.errors import ConfigError
from physx_remote import GodotGymClient, GodotGymEnv, Messages, connect
from physx_remote.errors import (
    RemoteClosedError,
    RemoteError,
    RemoteProtocolError,
    RemoteTimeoutError,
)
from physx_remote.godot_gym.messages import fill


def test_a_server_that_says_nothing_of_itself(in_thread, scene_class):
    class Silent(scene_class):
        def _described(self):
            return "{}"

        def _send_response(self, observation_request):
            if "environment" in observation_request:
                self.communication.put_message(self.messages.Message())  # as a Godot application
            else:
                super()._send_response(observation_request)

    service = in_thread(Silent(), clients="serve")
    with pytest.raises(RemoteError, match="Pass messages="):
        GodotGymEnv(service.address)
    messages = service.environment.messages
    with pytest.raises(RemoteError, match="pass action_space="):
        GodotGymEnv(service.address, messages=messages, observation_space=spaces.Discrete(2))

    class Walk(GodotGymEnv):
        def observation_of(self, data):
            return data["agent"]["a"]

        def ended_of(self, data):
            return False, bool(data["world"]["done"])

    env = Walk(
        service.address,
        messages=messages.Message,
        observation_space=spaces.Box(-9, 9, (1,), np.float32),
        action_space=spaces.Box(-1, 1, (1,), np.float32),
        requested_observation={"agent": ["a"], "world": ["done"]},
        time_speed=100,
        repeat_action=2,
    )
    assert env.reset()[0] == [0.0]
    assert env.step(np.ones(1, np.float32)) == ([8.0], 0.0, False, True, {"big": -1})
    env.close()


def test_a_client_with_invalid_messages():
    with pytest.raises(ConfigError, match="no message Message"):
        GodotGymClient(np)
    with pytest.raises(ConfigError, match="no message Message"):
        GodotGymClient(Field)


class Stub:
    """A server that answers with the bytes that it is given, and then ends the connection."""

    def __init__(self, *answers):
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = self.listener.getsockname()
        self.answers, self.wait = answers, threading.Event()
        self.thread = threading.Thread(target=self._serve)
        self.thread.start()

    def _serve(self):
        connection, _ = self.listener.accept()
        with connection:
            for answer in self.answers:
                connection.recv(65536)
                if answer is None:
                    self.wait.wait(60)
                else:
                    connection.sendall(answer)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.wait.set()
        self.thread.join(60)
        self.listener.close()


MESSAGES = Messages.of_fields(agent=[Field("a", (1,))])


@pytest.mark.parametrize("part", [b"", b"\x08\0", b"\x08\0\0\0", b"\x08\0\0\0\x0a\x06"])
def test_closed_connection_raises(part):
    with Stub(bytes(4), part) as stub, GodotGymClient(MESSAGES, stub.address) as client:
        assert client.request({}) == {"agent": None, "world": None}
        with pytest.raises(RemoteClosedError, match="closed the connection"):
            client.request({"observation": {"agent": []}})
        with pytest.raises(RemoteClosedError, match="is closed: "):
            client.request({})


def test_answer_timeout():
    with Stub(None) as stub, GodotGymClient(MESSAGES, stub.address, timeout=0.05) as client:
        with pytest.raises(RemoteTimeoutError, match=r"within 0\.05 s"):
            client.request({})
        with pytest.raises(RemoteClosedError, match="took longer"):
            client.request({})


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (struct.pack("<I", 1 << 31), "2147483648 bytes"),
        (struct.pack("<I", 4) + b"\x0a\xff\xff\xff", "4 bytes does not fit the given messages"),
    ],
)
def test_oversized_or_malformed_answer_is_an_error(answer, said):
    with (
        Stub(answer) as stub,
        GodotGymClient(MESSAGES, stub.address) as client,
        pytest.raises(RemoteProtocolError, match=said),
    ):
        client.request({})


@pytest.mark.parametrize("cut", range(1, 22))
def test_answers_that_come_in_pieces(cut):
    body = MESSAGES.Message()
    fill(body.agent_data, a=[3.0])
    data = body.SerializeToString()
    answer = struct.pack("<I", len(data)) + data
    listener = socket.create_server(("127.0.0.1", 0))
    with listener, GodotGymClient(MESSAGES, listener.getsockname()) as client:
        connection, _ = listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with connection:
            connection.sendall(answer[:cut])
            rest = threading.Timer(0.005, connection.sendall, [answer[cut:]])
            rest.start()
            assert client.request({})["agent"]["a"] == [3.0]
            rest.join()


def test_closing_and_addresses():
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        with pytest.raises(RemoteTimeoutError, match="Start the server first"):
            GodotGymClient(MESSAGES, silent.getsockname(), connect_timeout=0.05)
    with pytest.raises(ConfigError, match='give "host:port"'):
        connect("localhost", "godot-gym")
    with Stub() as stub:
        client = GodotGymClient(MESSAGES, stub.address)
        client.close()
        client.close()
        with pytest.raises(RemoteClosedError, match="closed here"):
            client.request({})


def test_a_client_waits_for_its_server():
    with socket.socket() as late:
        late.bind(("127.0.0.1", 0))

        def serve():
            late.listen()
            connection, _ = late.accept()
            with connection:
                connection.recv(65536)
                connection.sendall(bytes(4))

        later = threading.Timer(0.2, serve)
        later.start()
        with GodotGymClient(MESSAGES, late.getsockname(), connect_timeout=30) as client:
            assert client.request({}) == {"agent": None, "world": None}
        later.join()
