"""Encrypted sockets against a model: a stream of bytes, whatever the sizes, cuts and changes."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
)
from sizes import size

from physx_core.errors import ConnectionRefusedByPeerError, SilentPeerError, UnansweredError
from physx_core.net import FrameReader, Kind, Listener, SecureSocket, encrypt, pack
from physx_core.net.connection import Connection
from physx_core.net.tls import Identity

IDENTITY = Identity()
PATIENCE = 30.0


def pair():
    """Two ends of a connection on this machine."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        near = socket.create_connection(listener.getsockname(), PATIENCE)
        far, _ = listener.accept()
    far.settimeout(PATIENCE)
    return near, far


def shake_hands(near, far):
    """Encrypt a connection; return its ends, neither of which blocks."""
    made = []
    server = SecureSocket.of_server(far, IDENTITY, set())
    thread = threading.Thread(target=lambda: made.append(encrypt(near, always=True)))
    thread.start()
    server.setblocking(False)
    deadline = time.monotonic() + PATIENCE
    while thread.is_alive() and time.monotonic() < deadline:
        select.select([server], [], [], 0.01)
        with contextlib.suppress(BlockingIOError):
            server.recv_into(bytearray(1))
    thread.join()
    (client,) = made
    client.setblocking(False)
    return client, server


def test_a_server_that_sends_early_waits_for_the_end_of_the_handshake():
    (near, away), (back, far) = pair(), pair()
    server, made = SecureSocket.of_server(far, IDENTITY, set()), []
    server.setblocking(False)
    thread = threading.Thread(target=lambda: made.append(encrypt(near, always=True)))
    thread.start()
    back.sendall(away.recv(100_000))  # its hello
    with pytest.raises(BlockingIOError):
        server.recv_into(bytearray(1))
    with pytest.raises(BlockingIOError):
        server.send(b"welcome")
    away.sendall(back.recv(100_000))
    back.sendall(away.recv(100_000))  # its last message
    assert server.send(b"welcome") == 7
    thread.join()
    (client,) = made
    away.sendall(back.recv(100_000))
    assert client.recv(10) == b"welcome"
    client.sendall(b"thanks")
    back.sendall(away.recv(100_000))
    assert server.recv(10) == b"thanks"
    for each in (client, server, away, back):
        each.close()


def receive_all(end):
    """Return what arrives until the end, as the system or `hidden` tell, and the error."""
    received = bytearray()
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        if not end.buffered and not select.select([end], [], [], 1.0)[0]:
            continue
        try:
            data = end.recv(5000)
        except BlockingIOError:
            continue
        except OSError as error:
            return bytes(received), error
        if not data:
            return bytes(received), None
        received += data
    pytest.fail("it never ended")


class Stream(RuleBasedStateMachine):
    """Two ends that send and receive in any order; the model is the bytes that are on their way."""

    @initialize()
    def connect(self):
        self.ends = shake_hands(*pair())
        for end in self.ends:  # so that what is sent has to wait
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 14)
        self.waiting = [bytearray(), bytearray()]
        self.travelling = [bytearray(), bytearray()]
        self.count = 0

    @rule(side=st.sampled_from([0, 1]), sizes=st.lists(st.integers(0, 70_000), max_size=6))
    def write(self, side, sizes):
        """Send several parts behind what waits, as `Connection` does."""
        self.count += 1
        parts = [
            bytes([self.count % 256, number]) * (size // 2) for number, size in enumerate(sizes)
        ]
        sent = 0
        if not self.waiting[side] and parts:
            with contextlib.suppress(BlockingIOError):
                sent = self.ends[side].sendmsg(parts)
        whole = b"".join(parts)
        assert sent <= len(whole)
        self.travelling[side] += whole
        self.waiting[side] += whole[sent:]

    @rule()
    def flush(self):
        for end, waiting in zip(self.ends, self.waiting, strict=True):
            with contextlib.suppress(BlockingIOError):
                del waiting[: end.send(bytes(waiting))]

    @rule(side=st.sampled_from([0, 1]), size=st.integers(1, 200_000))
    def read(self, side, size):
        buffer = bytearray(size)
        with contextlib.suppress(BlockingIOError):
            count = self.ends[side].recv_into(buffer)
            assert count
            expected = self.travelling[1 - side]
            assert buffer[:count] == expected[:count]
            del expected[:count]

    @invariant()
    def what_the_system_does_not_know_of_is_hidden(self):
        for end in getattr(self, "ends", ()):
            assert end.buffered <= {end}

    def teardown(self):
        if not hasattr(self, "ends"):
            return
        deadline = time.monotonic() + PATIENCE
        while any(self.waiting) or any(self.travelling):
            self.flush()
            for side, end in enumerate(self.ends):
                if end.buffered or select.select([end], [], [], 0)[0]:
                    self.read(side, 3000)
            assert time.monotonic() < deadline
        for end, other in (self.ends, self.ends[::-1]):
            end.settimeout(PATIENCE)
            end.shutdown(socket.SHUT_WR)
            end.setblocking(False)
            assert receive_all(other) == (b"", None)
        for end in self.ends:
            end.close()


TestStream = Stream.TestCase
TestStream.settings = settings(max_examples=size(25, 4), stateful_step_count=25, deadline=None)


@pytest.mark.slow
@settings(max_examples=size(40, 5))
@given(data=st.data())
def test_tls_truncation_and_corruption_are_errors(data):
    near, relay_near = pair()
    relay_far, far = pair()
    relay = Relay(relay_near, relay_far)
    with relay, contextlib.ExitStack() as stack:
        client, server = map(stack.enter_context, shake_hands(near, far))
        message = os.urandom(data.draw(st.integers(1, 60_000)))
        encrypted = relay.hold(client, message)
        # What waits before it, of the handshake, differs from time to time.
        place = data.draw(st.integers(0, 2**20)) % len(encrypted)
        if data.draw(st.booleans()):
            encrypted[place] ^= data.draw(st.integers(1, 255))
        else:
            del encrypted[place:]
        relay_far.sendall(encrypted)
        relay_far.close()
        received, error = receive_all(server)
    assert message.startswith(received)
    assert received != message or isinstance(error, ConnectionResetError)  # no goodbye arrived
    assert isinstance(error, ConnectionResetError | ConnectionAbortedError), error


class Relay:
    """Passes bytes on in both directions until it is told to hold them."""

    def __init__(self, *ends):
        self.ends = ends
        self.over = threading.Event()
        self.thread = threading.Thread(target=self.work)

    def __enter__(self):
        self.thread.start()

    def __exit__(self, *_):
        self.over.set()
        self.thread.join()
        for end in self.ends:
            end.close()

    def work(self):
        while not self.over.is_set():
            for end in select.select(self.ends, [], [], 0.01)[0]:
                self.ends[end is self.ends[0]].sendall(end.recv(1 << 16))

    def hold(self, sender, message):
        """Return a message as it travels."""
        self.over.set()
        self.thread.join()
        near = self.ends[0]
        near.setblocking(False)
        travelling, rest = bytearray(), memoryview(message)
        deadline = time.monotonic() + PATIENCE
        while rest or select.select([near], [], [], 0.05)[0]:
            with contextlib.suppress(BlockingIOError):
                rest = rest[sender.send(rest) :] if rest else rest
            with contextlib.suppress(BlockingIOError):
                travelling += near.recv(1 << 16)
            assert time.monotonic() < deadline
        assert message[:8] not in travelling or len(message) < 8
        return travelling


# Frames by a listener -----------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [(0, 100, 0), (1 << 17, 5, 1 << 17), (3 << 20, 1 << 20, 7)])
def test_a_listener_finds_every_frame_though_the_system_sees_none_of_it(sizes):
    connections = []
    listener = Listener[Connection](
        lambda connected, name: connections.append(
            Connection(connected, FrameReader(1 << 30), name)
        ),
        lambda connection: None,
        encrypts=True,
    )
    listener.listen("127.0.0.1", 0)
    frames = [os.urandom(size) for size in sizes]
    here = socket.create_connection(listener.address, PATIENCE)

    def send():
        with encrypt(here, always=True) as connection:
            connection.sendall(b"".join(pack(Kind.ROWS, frame) for frame in frames))

    thread = threading.Thread(target=send)
    thread.start()
    found, ended = [], False
    deadline = time.monotonic() + PATIENCE
    while not ended and time.monotonic() < deadline:
        for connection, _ in listener.select(1.0):
            try:  # as little as possible at a time
                ended = not connection.reader.receive(connection.link)
            except BlockingIOError:
                continue
            frame = connection.reader.take()
            if frame is not None:
                found.append(bytes(frame.payload))
        if listener.accept() and connections[0].events == 0:
            listener.add(connections[0])
    thread.join()
    while (frame := connections[0].reader.take()) is not None:
        found.append(bytes(frame.payload))
    assert found == frames
    connections[0].close()
    listener.close()


# Who does not encrypt -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answer", "error", "text"),
    [
        (b"", UnansweredError, "does not support encryption"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", ConnectionRefusedByPeerError, "does not use physx"),
        (pack(Kind.CHALLENGE, bytes(76)), ConnectionRefusedByPeerError, "does not use physx"),
        (b"\x15\x03\x03\x00\x02\x02\x28", ConnectionRefusedByPeerError, "does not use physx"),
        (None, SilentPeerError, "in time"),
    ],
)
def test_server_without_tls_is_detected(answer, error, text):
    near, far = pair()
    near.settimeout(0.3 if answer is None else PATIENCE)
    with far:
        if answer is not None:
            far.sendall(answer)
            far.shutdown(socket.SHUT_WR)
        with pytest.raises(error, match=text) as caught:
            encrypt(near, always=True)
    assert type(caught.value) is error


@pytest.mark.slow
def test_slow_tls_handshake_times_out():
    near, far = pair()
    near.settimeout(0.5)
    over = threading.Event()

    def drip():
        far.sendall(b"\x16\x03\x03\x40\x00")
        with contextlib.suppress(OSError):
            while not over.wait(0.05):
                far.sendall(b"\x02")

    thread = threading.Thread(target=drip)
    thread.start()
    with far, pytest.raises(SilentPeerError):
        encrypt(near, always=True)
    over.set()
    thread.join()


def test_loopback_connection_uses_no_tls():
    near, far = pair()
    with near, far:
        assert encrypt(near) is near
    one, other = socket.socketpair()
    with one, other:
        assert encrypt(one) is one


@pytest.mark.parametrize("data", [b"", b"\x16", b"\x16" * 100, b"\x17\x03\x03", b"GET / HTTP/1.1"])
def test_first_byte_selects_tls_or_plain(data):
    near, far = pair()
    server = SecureSocket.of_server(far, IDENTITY, set())
    with near, server:
        near.sendall(data)
        near.shutdown(socket.SHUT_WR)
        if data[:1] == b"\x16":
            assert isinstance(receive_all(server)[1], OSError)
        else:
            assert receive_all(server) == (data, None)
            assert server.channel == b""
            plain = server.unwrap_if_plain()
            assert type(plain) is socket.socket
            plain.close()


def test_private_key_is_never_on_disk(tmp_path, monkeypatch):
    import tempfile

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    opened = []

    def audit(event, arguments):
        if event == "open" and opened is not None:
            opened.append(str(arguments[0]))

    import sys

    sys.addaudithook(audit)
    Identity().prepare()
    taken, opened = opened, None
    assert not [*tmp_path.iterdir()]
    assert not [name for name in taken if str(tmp_path) in name]
    first, second = Identity(), Identity()
    first.prepare()
    second.prepare()
    assert len(first.fingerprint) == 32
    assert first.fingerprint != second.fingerprint
