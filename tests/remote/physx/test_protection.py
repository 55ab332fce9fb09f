"""The protocol physx between machines, encrypted; the others say that they are not."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from physx_core.net import (
    FrameReader,
    PlainRefusedError,
    SecureSocket,
    encrypt,
    introduce,
)
from physx_core.net.tls import Identity
from physx_remote import PhysxObserver, connect, connect_vector, serve
from physx_remote.errors import RemoteClosedError, RemoteError
from physx_remote.physx.wire import ACT

pytestmark = pytest.mark.processes

TOKEN = "0123456789abcdef"
PATIENCE = 30.0


class Wide(gymnasium.Env):
    """Shows numbers that are easily found again, as many as are asked for."""

    action_space = spaces.Box(-9, 9, (2,), np.float64)

    def __init__(self, size=300_000):
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float64)
        self.size = size

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.full(self.size, 0.123456789), {}

    def step(self, action):
        seen = np.arange(self.size) + action[0]
        return seen, float(action.sum()), False, False, {"note": "seen by nobody else"}


@pytest.fixture
def here(another_machine):
    """Our address on a network."""
    return another_machine.address


def text(service):
    return "{}:{}".format(*service.address)


def test_large_observations_infos_and_observers_over_an_encrypted_connection(serving, here):
    service = serving(Wide, address=here, num_worlds=2)
    with (
        contextlib.closing(connect_vector(text(service), token=TOKEN)) as env,
        PhysxObserver(text(service), token=TOKEN) as observer,
    ):
        seen, _ = env.reset(seed=1)
        assert (seen == 0.123456789).all()
        for step in range(6):
            actions = np.full((2, 2), step / 2)
            seen, rewards, *_, infos = env.step(actions)
            assert np.array_equal(seen, np.stack([np.arange(300_000) + step / 2] * 2))
            assert rewards.tolist() == [step, step]
            assert infos["note"].tolist() == ["seen by nobody else"] * 2
        last = observer.last()
        assert np.array_equal(last.observation, seen)
        assert all(isinstance(one.link, SecureSocket) for one in service.connections)


def test_loopback_service_uses_no_tls(serving, another_machine):
    service = serving(Wide, address="0.0.0.0")
    port = service.address[1]
    with contextlib.closing(connect(f"127.0.0.1:{port}", token=TOKEN)) as near:
        near.reset()
        assert [type(one.link) for one in service.connections] == [socket.socket]


def test_client_without_tls_or_with_wrong_token_is_refused(serving, here):
    service = serving(Wide, address=here)
    with (
        socket.create_connection(service.address, PATIENCE) as plain,
        pytest.raises(PlainRefusedError),
    ):
        introduce(plain, TOKEN, ACT)
    with pytest.raises(RemoteError, match="cannot be trusted"):
        connect(text(service), token="another token, 16")
    with contextlib.closing(connect(text(service), token=TOKEN)) as env:
        env.reset()


def test_tls_detects_man_in_the_middle_of_service(serving, here):
    service = serving(Wide, address=here)
    heard = []
    with socket.create_server((here, 0)) as listener:

        def deceive():
            guest, _ = listener.accept()
            near = SecureSocket.of_server(guest, Identity(), set())
            far = encrypt(socket.create_connection(service.address, PATIENCE))
            with near, far:
                far.sendall(near.recv(1 << 16))  # the greeting, which holds no secret
                near.sendall(far.recv(1 << 16))  # a proof for another connection
                with contextlib.suppress(OSError):
                    heard.append(near.recv(1 << 16))

        thread = threading.Thread(target=deceive)
        thread.start()
        port = listener.getsockname()[1]
        with pytest.raises(RemoteError, match="someone in between answers in its place"):
            connect(f"{here}:{port}", token=TOKEN)
        thread.join()
    assert heard in ([], [b""])


def test_a_connection_that_is_forwarded_to_another_machine_is_encrypted(serving, here):
    service = serving(lambda: Wide(3), address=here)
    over = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def forward():
            while not over.is_set():
                guest, _ = listener.accept()
                onward = socket.create_connection(service.address, PATIENCE)
                for ends in ((guest, onward), (onward, guest)):
                    threading.Thread(target=copy, args=ends, daemon=True).start()

        def copy(source, target):
            with contextlib.suppress(OSError):
                while data := source.recv(1 << 16):
                    target.sendall(data)
                target.shutdown(socket.SHUT_WR)

        thread = threading.Thread(target=forward, daemon=True)
        thread.start()
        port = listener.getsockname()[1]
        with contextlib.closing(connect(f"127.0.0.1:{port}", token=TOKEN)) as env:
            assert env.reset()[0].tolist() == [0.123456789] * 3
            assert [type(one.link) for one in service.connections] == [SecureSocket]
        over.set()


def test_the_end_of_a_service_is_told_and_that_of_a_connection_is_no_answer(serving, here):
    service = serving(lambda: Wide(3), address=here)
    env = connect(text(service), token=TOKEN)
    env.reset()
    service.close()
    service.thread.join(PATIENCE)
    with pytest.raises(RemoteClosedError):
        env.step(np.zeros(2))
    env.close()
    with socket.create_server((here, 0)) as listener:

        def cut():
            guest, _ = listener.accept()
            with SecureSocket.of_server(guest, Identity(), set()) as near:
                FrameReader(1 << 10).read(near)
                near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

        thread = threading.Thread(target=cut)
        thread.start()
        port = listener.getsockname()[1]
        with pytest.raises(RemoteClosedError):
            connect(f"{here}:{port}", token=TOKEN, connect_timeout=5.0)
        thread.join()


def test_what_is_neither_encrypted_nor_authenticated_says_so(here, caplog):
    for protocol, address, warns in (
        ("godot-gym", here, True),
        ("godot-gym", "0.0.0.0", True),
        ("godot-gym", "127.0.0.1", False),
        ("godot-gym", "localhost", False),
        ("physx", here, False),
    ):
        caplog.clear()
        options = {"token": TOKEN} if protocol == "physx" else {}
        with serve("gym/CartPole-v1", protocol, address=address, **options):
            said = [one for one in caplog.messages if "neither encrypts nor authenticates" in one]
            assert bool(said) is warns, (protocol, address)
            assert all(one.startswith(address) for one in said)
