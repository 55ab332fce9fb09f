"""The protocol physx: services that end, what is no service, tokens, and what cannot be served."""

from __future__ import annotations

import contextlib
import itertools
import re
import socket
import struct
import threading

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from physx_core.errors import ConfigError, UsageError
from physx_core.net import FrameReader, Kind, ServerHandshake, pack, pack_header, pack_value
from physx_remote import PhysxObserver, RLEnvironment, connect, serve
from physx_remote.errors import (
    RemoteClosedError,
    RemoteError,
    RemoteProtocolError,
    RemoteTimeoutError,
)
from physx_remote.physx.link import PhysxLink
from physx_remote.physx.wire import ACT, SERVICE, VERSION
from physx_remote.serving.spaces import describe_space

TOKEN = "0123456789abcdef"
PATIENCE = 30.0
POLE = "gym/CartPole-v1"
NOTHING = {
    "service": SERVICE,
    "version": VERSION,
    "name": "nothing",
    "observation_space": describe_space(spaces.Discrete(3)),
    "action_space": describe_space(spaces.Discrete(3)),
    "num_worlds": 1,
    "snapshot": False,
    "render_mode": None,
    "render_modes": [],
    "render_fps": None,
}


class Waiting(gymnasium.Env):
    """Waits in a step for whoever sets `go`."""

    observation_space = action_space = spaces.Box(-9, 9, (2,), np.float32)

    def __init__(self):
        self.closed = False
        self.begun, self.go = threading.Event(), threading.Event()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.begun.set()
        assert self.go.wait(PATIENCE)
        return action, 0.0, False, False, {}

    def close(self):
        self.closed = True


def _text(service):
    return "{}:{}".format(*service.address)


# Services that end --------------------------------------------------------------------------------


def test_the_service_ends(serving):
    service = serving(POLE)
    client = connect(_text(service), token=TOKEN)
    observer = PhysxObserver(_text(service), token=TOKEN)
    client.reset()
    service.close()
    with pytest.raises(RemoteClosedError, match="closed the connection"):
        client.step(0)
    with pytest.raises(RemoteClosedError):
        while observer.next(PATIENCE):
            continue
    service.thread.join(PATIENCE)
    with pytest.raises(RemoteTimeoutError, match="Start the service first"):
        connect(_text(service), token=TOKEN, connect_timeout=0.05)


def test_closing_waits_for_the_step(serving):
    env = Waiting()
    service = serving(env)
    client = PhysxLink(service.address, ACT, token=TOKEN)
    client.send(pack_value(Kind.ACTIONS, {"action0": np.zeros((1, 2), np.float32)}, "a", 2))
    assert env.begun.wait(PATIENCE)
    service.close()
    assert not env.closed, "it is at work"
    env.go.set()
    with pytest.raises(RemoteClosedError):
        while client.receive():
            continue
    service.thread.join(PATIENCE)
    assert env.closed


# What is no service -------------------------------------------------------------------------------


@contextlib.contextmanager
def impostor(answer):
    """Listen, and have a function answer the only guest."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def work():
            guest, _ = listener.accept()
            with guest:
                answer(guest)

        thread = threading.Thread(target=work)
        thread.start()
        yield "{}:{}".format(*listener.getsockname())
        thread.join(PATIENCE)


@pytest.mark.parametrize(
    "said",
    [b"\xff" * 64, pack_header(Kind.CHALLENGE, 1 << 30), b"", pack(Kind.CHALLENGE, b"x" * 76)],
    ids=["noise", "1GB", "nothing", "lie"],
)
def test_what_is_no_service(said):
    def answer(guest):
        guest.recv(100)
        guest.sendall(said)

    with impostor(answer) as address, pytest.raises(RemoteError):
        connect(address, token=TOKEN)


@pytest.mark.parametrize(
    ("introduction", "answer", "message"),
    [
        ({**NOTHING, "service": "run"}, b"", "does not serve environments"),
        ({**NOTHING, "version": 9}, b"", "speaks version 9"),
        ({**NOTHING, "observation_space": {"kind": "Odd"}}, b"", "invalid description of a space"),
        (NOTHING, pack_value(Kind.ANSWER, {}, "", 3), "answer to request 3 instead of 1"),
        (NOTHING, pack_value(Kind.SETUP, {}, "", 1), "a message SETUP"),
        (
            NOTHING,
            pack_value(Kind.ANSWER, {"a": np.zeros(2)}, "", 1),
            "without the arrays of worlds",
        ),
        (NOTHING, pack_value(Kind.REFUSAL, {"classes": 1}, "", 1), "does not describe an error"),
        (NOTHING, struct.pack("<IHHQ", 1 << 30, Kind.ANSWER, 0, 1), "not a physx message"),
        (NOTHING, pack(Kind.ANSWER, b"\xff" * 40, 1), "damaged"),
    ],
)
def test_malformed_answers_of_service_are_errors(introduction, answer, message):
    def work(guest):
        handshake, reader = ServerHandshake(TOKEN), FrameReader(1000)
        guest.sendall(handshake.answer(reader.read(guest)))
        handshake.answer(reader.read(guest))
        guest.sendall(pack_value(Kind.SETUP, introduction, ""))
        with contextlib.suppress(EOFError):
            if reader.read(guest).kind is Kind.REQUEST:
                guest.sendall(answer)

    with impostor(work) as address, pytest.raises(Exception, match=message) as told:
        connect(address, token=TOKEN).reset()
    assert isinstance(told.value, RemoteError), told.value


def test_an_answer_that_is_too_long(serving):
    service = serving(POLE)
    with pytest.raises(RemoteProtocolError, match="longer than the 40 bytes"):
        connect(_text(service), token=TOKEN, max_answer=40)


# What is served, and by what token ----------------------------------------------------------------


def test_what_cannot_be_served():
    class Scene(RLEnvironment):
        pass

    with pytest.raises(UsageError, match="godot-gym"):
        serve(Scene(), "physx", token=TOKEN)
    with pytest.raises(ConfigError, match="at least 16"):
        serve(POLE, "physx", token="short")
    with pytest.raises(ConfigError, match="handshake_timeout"):
        serve(POLE, "physx", handshake_timeout=0)


WRONG = [
    *itertools.product(("handshake_timeout", "max_clients"), ("many", True, [1])),
    *itertools.product(("max_request", "max_snapshots"), ("many", 1.5, None)),
    *itertools.product(("token", "token_file"), (1.5, True, [1])),
]


@pytest.mark.parametrize(("option", "value"), WRONG)
def test_service_option_of_wrong_type_is_named(option, value):
    with pytest.raises(ConfigError, match=f"{option} is {re.escape(repr(value))}"):
        serve(POLE, "physx", **{option: value})


def test_a_token_of_ones_own_and_none_at_all(serving, monkeypatch, tmp_path):
    monkeypatch.delenv("PHYSX_TOKEN", raising=False)
    with serve(POLE, "physx") as service:
        assert len(service.token) == 64
    with pytest.raises(ConfigError, match="PHYSX_TOKEN"):
        connect("127.0.0.1:1")
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    with connect(_text(serving(POLE)), token_file=str(file)) as env:
        env.reset()
    monkeypatch.setenv("PHYSX_TOKEN", TOKEN)
    with connect(_text(serving(POLE))) as env:
        env.reset()
