"""Servers that lie: whatever they say, the clients raise the documented errors, and soon."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import threading
import time

import numpy as np
import pytest
from gymnasium import spaces

from physx_core.errors import ConfigError
from physx_core.net import FrameReader, Kind, ServerHandshake, encode_error, pack, pack_value
from physx_remote import Messages, PhysxObserver, connect, connect_vector
from physx_remote.errors import RemoteError, RemoteProtocolError, RemoteTimeoutError
from physx_remote.godot_gym.messages import DESCRIPTION, encode_extension
from physx_remote.physx.wire import SERVICE, VERSION
from physx_remote.serving.spaces import describe_space

TOKEN = "0123456789abcdef"
DEEP = b"[" * 100_000
DEEPER = "[" * 900 + "]" * 900
HUGE = 10**12
BOX = describe_space(spaces.Box(-1, 1, (2,), np.float32))
TWO = describe_space(spaces.Discrete(2))


def framed(body):
    body = body if isinstance(body, bytes) else json.dumps(body).encode()
    return struct.pack("<I", len(body)) + body


@pytest.fixture
def liar():
    """Listen, and have a function answer the only guest; return the address."""
    with contextlib.ExitStack() as stack:

        def start(answer):
            listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))

            def work():
                guest, _ = listener.accept()
                with guest, contextlib.suppress(OSError, EOFError):
                    answer(guest)

            thread = threading.Thread(target=work)
            thread.start()
            stack.callback(thread.join, 60)
            return "{}:{}".format(*listener.getsockname())

        yield start


# godot-gym ----------------------------------------------------------------------------------------


def answering(*bodies):
    """Answer each request with the next body, and then leave."""

    def answer(guest):
        for body in bodies:
            guest.recv(1 << 16)
            guest.sendall(framed(body))

    return answer


DESCRIBED = {
    "version": 1,
    "messages": {
        "agent": [{"name": "observation", "shape": [2], "dtype": "<f4"}],
        "world": [
            {"name": "reward", "text": True},
            {"name": "terminated", "shape": [], "dtype": "|b1"},
            {"name": "info", "text": True},
        ],
    },
    "spaces": {"observation": BOX, "action": TWO},
}


def described(**changes):
    return encode_extension(DESCRIPTION, json.dumps({**DESCRIBED, **changes}))


def parts(agent=(0.0, 0.0), **world):
    """Return an answer in the messages that are described."""
    message = Messages.from_dict(DESCRIBED["messages"]).Message()
    message.agent_data.observation.extend(agent)
    message.world_data.SetInParent()
    for name, value in world.items():
        setattr(message.world_data, name, value)
    return message.SerializeToString()


FIELD = {"name": "a", "shape": [], "dtype": "<f4"}


@pytest.mark.parametrize(
    "description",
    [
        described(messages=5),
        described(messages={"agent": 5}),
        described(messages={"agent": [5], "world": []}),
        described(messages={"agent": [{}], "world": []}),
        described(messages={"agent": [FIELD, FIELD], "world": []}),
        described(messages={"agent": [{**FIELD, "name": "a b"}], "world": []}),
        described(messages={"agent": [{**FIELD, "dtype": "object"}], "world": []}),
        described(messages={"agent": [{**FIELD, "shape": "x"}], "world": []}),
        described(messages={"agent": [{"name": 5, "text": True}], "world": []}),
        described(
            messages={"agent": [{"name": "a", "shape": [HUGE], "dtype": "<f4"}], "world": []},
            spaces={"action": TWO},
        ),
        described(spaces=5),
        described(spaces={"observation": 5}),
        described(spaces={"observation": {**BOX, "shape": [HUGE]}, "action": TWO}),
        described(spaces={"observation": {**BOX, "shape": [-1]}, "action": TWO}),
        described(spaces={"observation": {**BOX, "low": "x"}, "action": TWO}),
        described(spaces={"observation": {"kind": "MultiBinary", "n": HUGE}, "action": TWO}),
        described(spaces={"observation": {**TWO, "n": 10**400}, "action": TWO}),
        described(version=2),
        encode_extension(DESCRIPTION, DEEP.decode()),
        encode_extension(DESCRIPTION, DEEPER),
        encode_extension(DESCRIPTION, "{"),
        DEEP,
        b"\xff" * 100,
        b"",
    ],
)
def test_malformed_description_is_an_error(liar, description):
    with pytest.raises(RemoteError):
        connect(liar(answering(description)), "godot-gym", timeout=20.0)


@pytest.mark.parametrize(
    "answer",
    [
        parts(reward="much", terminated=False, info=""),
        parts(reward="1", info="{"),
        parts(reward="1", info="5"),
        parts(reward="1", info=DEEP.decode()),
        parts(agent=(1.0,), reward="1"),
        DEEP,
        b"",
    ],
)
def test_malformed_answer_is_an_error(liar, answer):
    with connect(liar(answering(described(), parts(), answer)), "godot-gym", timeout=20.0) as env:
        env.reset()
        with pytest.raises(RemoteProtocolError):
            env.step(0)


# physx --------------------------------------------------------------------------------------------

WORLDS = {
    "service": SERVICE,
    "version": VERSION,
    "name": "lies",
    "observation_space": BOX,
    "action_space": TWO,
    "num_worlds": 2,
    "snapshot": True,
    "render_mode": None,
    "render_modes": [],
    "render_fps": None,
}
STEPPED = {
    "reward": np.zeros(2),
    "observation0": np.zeros((2, 2), np.float32),
    "terminated": np.zeros(2, bool),
    "truncated": np.zeros(2, bool),
}


def without(name):
    return {key: value for key, value in WORLDS.items() if key != name}


def trusted(introduction, *answers):
    """Know the token, introduce oneself, and answer each request with the next bytes."""

    def answer(guest):
        handshake, reader = ServerHandshake(TOKEN), FrameReader(1 << 20)
        guest.sendall(handshake.answer(reader.read(guest)))
        handshake.answer(reader.read(guest))
        if not isinstance(introduction, bytes):
            guest.sendall(pack_value(Kind.SETUP, introduction, "introduction"))
        else:
            guest.sendall(introduction)
        for each in answers:
            reader.read(guest)
            guest.sendall(each)

    return answer


@pytest.mark.parametrize("client", [connect, connect_vector, PhysxObserver])
@pytest.mark.parametrize(
    "introduction",
    [
        5,
        *map(without, WORLDS),
        {**WORLDS, "num_worlds": HUGE},
        {**WORLDS, "num_worlds": "two"},
        {**WORLDS, "num_worlds": 0},
        {**WORLDS, "render_modes": 5},
        {**WORLDS, "observation_space": 5},
        {**WORLDS, "observation_space": {**BOX, "shape": [HUGE]}},
        {**WORLDS, "observation_space": {"kind": "MultiBinary", "n": HUGE}},
        {**WORLDS, "action_space": {**BOX, "dtype": "object"}},
        pack(Kind.ERROR, encode_error(ConfigError("the service is on strike"))),
        pack(Kind.ERROR, b"\xff" * 30),
        pack(Kind.ANSWER, b"", 7),
        b"\xff" * 64,
    ],
)
def test_malformed_introduction_is_an_error(liar, client, introduction):
    with pytest.raises(RemoteError):
        client(liar(trusted(introduction)), token=TOKEN, timeout=20.0)


@pytest.mark.parametrize(
    "answer",
    [
        5,
        {},
        {**STEPPED, "reward": "much"},
        {**STEPPED, "reward": np.array(["a", "b"])},
        {**STEPPED, "reward": np.zeros((2, 2))},
        {**STEPPED, "observation0": np.zeros((2, 3), np.float32)},
        {**STEPPED, "observation0": np.zeros((2, 2))},
        {**STEPPED, "terminated": np.zeros(2)},
        {**STEPPED, "truncated": None},
    ],
)
def test_malformed_step_outcome_is_an_error(liar, answer):
    said = trusted(WORLDS, pack_value(Kind.ANSWER, answer, "", 1))
    with (
        contextlib.closing(connect_vector(liar(said), token=TOKEN, timeout=20.0)) as worlds,
        pytest.raises(RemoteProtocolError),
    ):
        worlds.reset()


@pytest.mark.parametrize(
    "notes",
    [
        5,
        {"infos": [{}, {}], "left_out": [[]]},
        {"infos": [{}], "left_out": []},
        {"infos": [{"a": 1}, {"a": "x"}], "left_out": []},
    ],
)
def test_malformed_infos_are_an_error(liar, notes):
    said = pack_value(Kind.NOTES, notes, "", 1) + pack_value(Kind.ANSWER, STEPPED, "", 1)
    with (
        contextlib.closing(
            connect_vector(liar(trusted(WORLDS, said)), token=TOKEN, timeout=20.0)
        ) as worlds,
        pytest.raises(RemoteProtocolError),
    ):
        worlds.reset()


def test_malformed_snapshot_is_an_error(liar):
    said = trusted({**WORLDS, "num_worlds": 1}, pack_value(Kind.ANSWER, "seven", "", 1))
    with (
        connect(liar(said), token=TOKEN, timeout=20.0) as env,
        pytest.raises(RemoteProtocolError, match="without a number"),
    ):
        env.snapshot()


@pytest.mark.parametrize(
    "change",
    [{"worlds": None}, {"worlds": np.zeros((2, 2))}, {"reward": "x"}, {"is_reset": np.zeros(3)}],
)
def test_malformed_change_is_an_error(liar, change):
    seen = {"worlds": np.arange(2), "is_reset": np.bool_(True), **STEPPED, **change}
    said = pack_value(Kind.SETUP, WORLDS, "") + pack_value(Kind.SEEN, seen, "", 1)
    with (
        PhysxObserver(liar(trusted(said)), token=TOKEN, timeout=20.0) as observer,
        pytest.raises(RemoteProtocolError),
    ):
        observer.next(20.0)


def drip(guest):
    for place in range(300):
        guest.sendall(pack(Kind.CHALLENGE, bytes(256))[place : place + 1])
        time.sleep(0.05)


def wait(guest):
    guest.settimeout(20)
    while guest.recv(1 << 10):
        continue


@pytest.mark.slow
@pytest.mark.parametrize("said", [wait, drip])
def test_handshake_timeout_is_told_from_wrong_token(liar, said):
    began = time.monotonic()
    with pytest.raises(RemoteTimeoutError, match="did not answer within 1 s"):
        connect(liar(said), token=TOKEN, connect_timeout=0.5)
    assert time.monotonic() - began < 4.0


# godot-rl -----------------------------------------------------------------------------------------

ENTRY = {"obs": {"size": [2], "space": "box"}}
MOVE = {"move": {"size": 3, "action_type": "discrete"}}
INFO = {"type": "env_info", "n_agents": 2, "observation_space": ENTRY, "action_space": MOVE}
SEEN = {"type": "reset", "obs": [{"obs": [1, 2]}] * 2}


@pytest.fixture
def application():
    """Answer a trainer that listens at a port with what is given."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = "{}:{}".format(*free.getsockname())
    threads = []

    def start(*answers):
        def work():
            until = time.monotonic() + 60
            while True:
                try:
                    host, port = address.split(":")
                    trainer = socket.create_connection((host, int(port)))
                    break
                except OSError:
                    assert time.monotonic() < until
                    time.sleep(0.01)
            with trainer, contextlib.suppress(OSError, struct.error):
                reader = trainer.makefile("rb")
                reader.read(struct.unpack("<I", reader.read(4))[0])  # the handshake
                for answer in answers:
                    reader.read(struct.unpack("<I", reader.read(4))[0])
                    trainer.sendall(framed(answer))

        threads.append(threading.Thread(target=work))
        threads[-1].start()
        return address

    yield start
    for thread in threads:
        thread.join(60)


@pytest.mark.parametrize(
    "told",
    [
        {**INFO, "observation_space": {"obs": {"size": [HUGE], "space": "box"}}},
        {**INFO, "observation_space": {"obs": {"size": [10**400], "space": "box"}}},
        {
            **INFO,
            "observation_space": {"obs": {"size": HUGE, "space": "discrete"}},
            "n_agents": HUGE,
        },
        {**INFO, "observation_space": {"obs": {"size": [2], "space": "box", "low": "x"}}},
        {**INFO, "action_space": {"move": {"size": HUGE, "action_type": "continuous"}}},
        {**INFO, "action_space": {"move": {"size": 10**400, "action_type": "discrete"}}},
        {**INFO, "action_space": {"move": 5}},
        {**INFO, "action_space": 5},
        {**INFO, "action_space": []},
        json.dumps({**INFO, "n_agents": 0}).replace("0", DEEPER).encode(),
        json.dumps({**INFO, "action_space": 0}).replace("0", DEEPER).encode(),
        {"type": "error", "message": [5]},
        DEEP,
    ],
)
def test_malformed_agents_are_an_error(application, told):
    with pytest.raises(RemoteError):
        connect_vector(application(told), "godot-rl", timeout=20.0)


@pytest.mark.parametrize(
    "told",
    [
        {**SEEN, "obs": [{"obs": [1, 10**400]}] * 2},
        json.dumps({**SEEN, "obs": 0}).replace("0", DEEPER).encode(),
        json.dumps({**SEEN, "obs": [{"obs": 0}] * 2}).replace("0", DEEPER).encode(),
        {**SEEN, "info": [{"a": 1}, {"a": "x"}]},
        {**SEEN, "info": [{"a": 1}, {"a": [1]}]},
        DEEP,
    ],
)
def test_malformed_observation_is_an_error(application, told):
    with (
        contextlib.closing(
            connect_vector(application(INFO, told), "godot-rl", timeout=20.0)
        ) as env,
        pytest.raises(RemoteProtocolError),
    ):
        env.reset()


@pytest.mark.parametrize("change", [{"reward": [10**400, 1]}, {"reward": None}, {"done": "no"}])
def test_malformed_step_is_an_error(application, change):
    step = {**SEEN, "type": "step", "reward": [1, 2], "done": [False, True], **change}
    with (
        contextlib.closing(
            connect_vector(application(INFO, step), "godot-rl", timeout=20.0)
        ) as env,
        pytest.raises(RemoteProtocolError),
    ):
        env.step({"move": np.array([0, 1])})


@pytest.mark.parametrize("returns", [5, [1], None])
def test_malformed_call_result_is_an_error(application, returns):
    told = {"type": "call", "returns": returns}
    with (
        contextlib.closing(
            connect_vector(application(INFO, told), "godot-rl", timeout=20.0)
        ) as env,
        pytest.raises(RemoteProtocolError),
    ):
        env.call("name")
