"""The protocol physx among strangers, liars and accidents: the service says so and lives on."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from physx_core.net import HEADER, Kind, decode_error, pack, pack_header, pack_value
from physx_remote import PhysxObserver, connect, connect_vector
from physx_remote.errors import RemoteClosedError, RemoteError, RemoteTimeoutError, RequestError
from physx_remote.physx.link import PhysxLink
from physx_remote.physx.wire import ACT

TOKEN = "0123456789abcdef"
PATIENCE = 30.0
HELLO = pack(Kind.HELLO, struct.pack("<8sI32s", b"physxtcp", 1, bytes(32)))
ACTIONS = {"action0": np.zeros((1, 2), np.float32)}


class Fragile(gymnasium.Env):
    """Fails where its action says so; waits in a step for whoever sets `go`."""

    observation_space = spaces.Box(-9, 9, (2,), np.float64)
    action_space = spaces.Box(-9, 9, (2,), np.float32)

    def __init__(self):
        self.steps, self.closed = 0, False
        self.begun, self.go = threading.Event(), threading.Event()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if options and "fail" in options:
            raise KeyError("no such room")
        return np.zeros(2), {}

    def step(self, action):
        match int(action[0]):
            case 1:
                raise ArithmeticError("the wheel came off")
            case 2:
                return np.zeros(3), 0.0, False, False, {}
            case 3:
                self.begun.set()
                assert self.go.wait(PATIENCE)
        self.steps += 1
        return np.full(2, float(self.steps)), 0.0, False, False, {}

    def close(self):
        self.closed = True


@pytest.fixture
def env():
    return Fragile()


@pytest.fixture
def service(serving, env):
    yield serving(env)
    env.go.set()


def lives(service):
    """Whether the next client is served, at the latest once the service knows that others left."""
    until = time.monotonic() + PATIENCE
    while True:
        try:
            with connect(_text(service), token=TOKEN) as env:
                env.reset()
                return env.step([0.0, 0.0])[0].shape == (2,)
        except RemoteError as error:
            is_full = "acts here already" in str(error) or "too many" in str(error)
            if not is_full or time.monotonic() > until:
                raise


def _text(service):
    return "{}:{}".format(*service.address)


def _raw(service):
    return socket.create_connection(service.address, PATIENCE)


def _is_closed(stranger):
    """Wait for the end of a connection."""
    with contextlib.suppress(ConnectionError):
        while stranger.recv(65536):
            continue
    return True


# Strangers ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "said",
    [
        b"GET / HTTP/1.1\r\nHost: physx.example\r\n\r\n",
        bytes(range(256)) * 8,
        pack_header(Kind.HELLO, 1 << 30),
        struct.pack("<IHHQ", 257, Kind.HELLO, 0, 0),
        HELLO + HELLO,
        HELLO + pack(Kind.PROOF, bytes(32), ACT),
        pack(Kind.PROOF, bytes(32), ACT),
        pack(Kind.HELLO, b"x" * 44),
        pack(Kind.HELLO, b"x"),
        pack_value(Kind.REQUEST, {"do": "last"}, "request"),
    ],
    ids=["http", "noise", "1GB", "257B", "twice", "lie", "proof", "magic", "short", "request"],
)
def test_malformed_handshake_is_refused(service, said):
    with _raw(service) as stranger:
        stranger.sendall(said)
        assert _is_closed(stranger)
    assert lives(service)


def test_handshake_version_mismatch_is_refused(service):
    with _raw(service) as stranger:
        stranger.sendall(pack(Kind.HELLO, struct.pack("<8sI32s", b"physxtcp", 9, bytes(32))))
        length, kind, _, _ = HEADER.unpack(_exactly(stranger, HEADER.size))
        assert kind == Kind.CHALLENGE and b"physxtcp" in _exactly(stranger, length)
    assert lives(service)


def test_wrong_token_is_refused_by_both_sides(service):
    with pytest.raises(RemoteError, match="does not know this client's token"):
        connect(_text(service), token="another-token-of-good-length")
    assert lives(service)


def test_a_client_that_wants_to_run_an_instance(service):
    with pytest.raises(RemoteError, match="not the server of a run"):
        PhysxLink(service.address, 0, token=TOKEN)
    assert lives(service)


def test_silent_connections_are_closed_after_timeout(serving, env):
    service = serving(env, handshake_timeout=0.05)
    with _raw(service) as silent, _raw(service) as half, _raw(service) as slow:
        half.sendall(HELLO)
        slow.sendall(HELLO[:5])
        assert all(_is_closed(stranger) for stranger in (silent, half, slow))
    service._pending.patience = PATIENCE  # the next one may be slow, but is no stranger
    assert lives(service)


def test_fifty_clients_at_once(service):
    with contextlib.ExitStack() as stack:
        strangers = [stack.enter_context(_raw(service)) for _ in range(20)]
        actor = stack.enter_context(connect(_text(service), token=TOKEN))
        observers = [
            stack.enter_context(PhysxObserver(_text(service), token=TOKEN)) for _ in range(29)
        ]
        actor.reset()
        actor.step([0.0, 0.0])
        for observer in observers:
            assert [observer.next(PATIENCE).number for _ in range(2)] == [1, 2]
        for stranger in strangers[::2]:
            stranger.sendall(b"x" * 100)
    assert lives(service)


def test_too_many_clients(serving, env):
    service = serving(env, max_clients=2)
    with connect(_text(service), token=TOKEN) as actor:
        with (
            PhysxObserver(_text(service), token=TOKEN),
            pytest.raises(RemoteError, match="Too many clients are connected: max_clients is 2"),
        ):
            PhysxObserver(_text(service), token=TOKEN)
        actor.reset()
    assert lives(service)


def test_unauthenticated_connections_take_no_client_slots(serving, env):
    service = serving(env, max_clients=4)
    with contextlib.ExitStack() as stack:
        for _ in range(50):
            stack.enter_context(_raw(service))
        with connect(_text(service), token=TOKEN) as actor:
            actor.reset()
            with PhysxObserver(_text(service), token=TOKEN) as observer:
                actor.step([0.0, 0.0])
                assert observer.next(PATIENCE).number == 2
        assert len(service.connections) <= 32 + 2


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ([0.0, np.nan], r"The action\[1\] of world 0 is nan, which is not a finite number"),
        ([-np.inf, 0.0], r"The action\[0\] of world 0 is -inf"),
    ],
)
def test_nan_actions_are_refused(service, env, value, said, caplog):
    with connect(_text(service), token=TOKEN) as client:
        client.reset()
        with pytest.raises(RequestError, match=said):
            client.step(value)
        assert env.steps == 0
        assert client.step([50.0, 0.0])[0].tolist() == [1.0, 1.0], "its own range is its own"
    assert "Traceback" not in caplog.text


def test_discrete_actions_beyond_their_range_are_refused(serving):
    service = serving("gym/CartPole-v1", num_worlds=2)
    with connect_vector(_text(service), token=TOKEN).client as client:
        client.reset(seeds=[1, 2])
        for wrong in (-1, 2):
            with pytest.raises(RequestError, match=rf"The action of world 1 is {wrong}, which is"):
                client.step({"action0": np.array([0, wrong])})
            with pytest.raises(RequestError, match=rf"The action of world 1 is {wrong}, which is"):
                client.step({"action0": np.array([wrong])}, [1])
        client.step({"action0": np.array([0, 1])})


# Clients that are trusted and err -----------------------------------------------------------------


@pytest.mark.parametrize(
    "said",
    [
        b"\xff" * 40,
        pack_header(Kind.ACTIONS, 1 << 30),
        struct.pack("<IHHQ", 10, 999, 0, 0),
        struct.pack("<IHHQ", 10, Kind.REQUEST, 5, 0),
        pack(Kind.ACTIONS, b"\xff" * 40, 1),
        pack(Kind.REQUEST, struct.pack("<I", 4) + b"[1,2", 1),
        pack(Kind.REQUEST, b"", 1),
    ],
    ids=["noise", "1GB", "kind", "spare", "values", "json", "empty"],
)
def test_malformed_message_closes_connection(service, said):
    link = PhysxLink(service.address, ACT, token=TOKEN)
    link.send(said)
    with pytest.raises(RemoteClosedError):
        link.receive()
    assert lives(service)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (Kind.REQUEST, {"do": "dance"}),
        (Kind.REQUEST, {"do": np.zeros(2)}),
        (Kind.REQUEST, {"do": "snapshot"}),
        (Kind.REQUEST, {}),
        (Kind.REQUEST, [1, 2]),
        (Kind.REQUEST, {"do": "reset", "worlds": "all"}),
        (Kind.REQUEST, {"do": "reset", "seeds": [1, 2]}),
        (Kind.REQUEST, {"do": "reset", "seeds": [-1]}),
        (Kind.REQUEST, {"do": "reset", "options": [1]}),
        (Kind.REQUEST, {"do": "restore", "snapshot": "x"}),
        (Kind.REQUEST, {"do": "render", "world": None}),
        (Kind.ACTIONS, {}),
        (Kind.ACTIONS, [1]),
        (Kind.ACTIONS, {"action0": 3}),
        (Kind.ACTIONS, {"action0": np.zeros((1, 2))}),
        (Kind.ACTIONS, {"action0": np.zeros((2, 2), np.float32)}),
        (Kind.ACTIONS, {"action0": np.zeros((1, 2), np.float32), "more": np.zeros(1)}),
        (Kind.ACTIONS, {"worlds": np.zeros(1), **ACTIONS}),
        (Kind.SETUP, {"do": "last"}),
    ],
)
def test_invalid_requests_are_answered_with_errors(service, kind, value):
    link = PhysxLink(service.address, ACT, token=TOKEN)
    link.send(pack_value(kind, value, "request", 5))
    frame = link.receive()
    assert (frame.kind, frame.number) == (Kind.REFUSAL, 5)
    assert isinstance(decode_error(frame.payload), RequestError)
    link.send(pack_value(Kind.REQUEST, {"do": "reset"}, "request", 6))
    assert (link.receive().kind, link.is_closed) == (Kind.ANSWER, False)
    link.close()
    assert lives(service)


def test_requests_byte_by_byte_and_all_at_once(service):
    link = PhysxLink(service.address, ACT, token=TOKEN)
    reset = pack_value(Kind.REQUEST, {"do": "reset"}, "request", 1)
    step = pack_value(Kind.ACTIONS, ACTIONS, "actions", 2)
    for byte in reset + step:
        link.send(bytes([byte]))
    assert [link.receive().number for _ in range(2)] == [1, 2]
    link.send((reset + step) * 20)
    assert [link.receive().number for _ in range(40)] == [1, 2] * 20
    link.close()


@pytest.mark.parametrize("how", ["fin", "rst"])
@pytest.mark.parametrize("state", ["guest", "half a proof", "actor", "half a request", "answer"])
def test_client_disconnect_frees_its_slot(service, state, how):
    if state in ("guest", "half a proof"):
        gone = _raw(service)
        gone.sendall(HELLO + pack(Kind.PROOF, bytes(32))[: 20 * (state != "guest")])
    else:
        gone = PhysxLink(service.address, ACT, token=TOKEN)._socket
        step = pack_value(Kind.ACTIONS, ACTIONS, "actions", 2)
        gone.setblocking(True)
        gone.sendall({"actor": b"", "half a request": step[:-3], "answer": step}[state])
    if how == "rst":
        gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    gone.close()
    assert lives(service)


def test_client_disconnect_during_step(service, env):
    leaving = PhysxLink(service.address, ACT, token=TOKEN)
    leaving.send(pack_value(Kind.REQUEST, {"do": "reset"}, "request", 1))
    leaving.receive()
    action = {"action0": np.array([[3, 0]], np.float32)}
    leaving.send(pack_value(Kind.ACTIONS, action, "actions", 2))
    assert env.begun.wait(PATIENCE)
    leaving.close()
    env.go.set()
    assert lives(service)
    assert env.steps == 2, "the step was finished, and then the next client's"


# Environments that fail ---------------------------------------------------------------------------


def test_an_exception_comes_with_its_traceback(service, caplog):
    with connect(_text(service), token=TOKEN) as env:
        env.reset()
        with pytest.raises(RequestError, match="World 0 failed.*the wheel came off") as told:
            env.step([1.0, 0.0])
        assert "match int(action[0])" not in str(told.value)
        assert 'raise ArithmeticError("the wheel came off")' in str(told.value.__cause__)
        with pytest.raises(RequestError, match="no such room"):
            env.reset(options={"fail": True})
        with pytest.raises(RemoteError, match=r"shape \(3,\)"):
            env.step([2.0, 0.0])
        assert env.step([0.0, 0.0])[0].tolist() == [1.0, 1.0]
    assert caplog.text.count("the wheel came off") >= 1
    assert lives(service)


def test_one_world_of_several_fails(serving):
    service = serving(Fragile, num_worlds=3)
    with contextlib.closing(connect_vector(_text(service), token=TOKEN)) as env:
        env.reset()
        with pytest.raises(RequestError, match="World 1 failed"):
            env.step(np.array([[0, 0], [1, 0], [0, 0]]))
        steps = env.step(np.zeros((3, 2)))[0][:, 0]
        assert steps.tolist() == [2, 1, 1], "the first had made its step"


def test_slow_answer_raises_timeout(service, env):
    late = connect(_text(service), token=TOKEN)
    late.reset()
    late.client.timeout = 0.05
    with pytest.raises(RemoteTimeoutError, match="longer timeout"):
        late.step([3.0, 0.0])
    with pytest.raises(RemoteClosedError, match="longer than"):
        late.step([0.0, 0.0])
    env.go.set()
    assert lives(service)


def _exactly(stranger, count):
    data = b""
    while len(data) < count:
        data += stranger.recv(count - len(data))
    return data
