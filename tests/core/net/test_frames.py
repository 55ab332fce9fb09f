"""Frames that are cut anywhere, and errors that travel in them."""

from __future__ import annotations

import socket
import threading
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sizes import size

from physx_core.errors import (
    ConfigError,
    ConnectionRefusedByPeerError,
    FieldShapeError,
    UnknownOptionError,
)
from physx_core.net import HEADER, FrameReader, Kind, decode_error, encode_error, pack
from physx_core.workers.client.link import WorkerLink

# Frames -----------------------------------------------------------------------------------------


@settings(max_examples=size(100, 12))
@given(
    st.lists(st.tuples(st.sampled_from(Kind), st.binary(max_size=300), st.integers(0, 2**64 - 1))),
    st.lists(st.integers(1, 200), min_size=1),
)
def test_frames_arrive_whole_however_they_are_cut(frames, cuts):
    here, there = socket.socketpair()
    with here, there:
        there.setblocking(False)
        reader, received = FrameReader(300), []
        data = b"".join(pack(*frame) for frame in frames)
        turn = 0
        while data:
            size = cuts[turn % len(cuts)]
            here.sendall(data[:size])
            data, turn = data[size:], turn + 1
            while (frame := reader.read(there)) is not None:
                received.append((frame.kind, bytes(frame.payload), frame.number))
        assert received == frames
        here.close()
        with pytest.raises(EOFError):
            reader.read(there)


def test_large_frames_arrive_between_small_ones():
    here, there = socket.socketpair()
    with here, there:
        large = np.arange(300_000).tobytes()
        data = [b"a", large, b"", large[:40_000], b"z"]
        sender = threading.Thread(
            target=lambda: [here.sendall(pack(Kind.ROWS, part)) for part in data]
        )
        sender.start()
        reader = FrameReader(1 << 30)
        assert [bytes(reader.read(there).payload) for _ in data] == data
        sender.join()
        assert not reader.may_have_more


@settings(max_examples=size(40, 5))
@given(
    st.lists(st.sampled_from([0, 5, 16_000, 16_384, 16_385, 70_000, 200_000, 2_500_000])),
    st.sampled_from([7, 1000, 16_000, 100_000, 1_000_000]),
)
def test_frames_of_any_length_arrive_in_their_order(lengths, cut):
    reader, received = FrameReader(1 << 30), []
    payloads = [np.full(length, place % 251, np.uint8) for place, length in enumerate(lengths)]
    data = b"".join(pack(Kind.ROWS, each.tobytes(), len(each)) for each in payloads)
    stream = InPieces(data, max(cut, len(data) // 2000))
    while (frame := reader.read(stream)) is not None:
        received.append(frame)
    assert [frame.number for frame in received] == lengths
    for frame, payload in zip(received, payloads, strict=True):
        assert frame.payload == payload.data
    assert not stream.data


class InPieces:
    """Has the bytes of a connection arrive in pieces."""

    def __init__(self, data, size):
        self.data, self.size = memoryview(data), size

    def recv_into(self, target):
        if not self.data:
            raise BlockingIOError
        piece = self.data[: min(self.size, len(target))]
        target[: len(piece)] = piece
        self.data = self.data[len(piece) :]
        return len(piece)


def test_announced_frame_length_allocates_no_memory():
    head = HEADER.pack(1 << 30, Kind.ROWS, 0, 1)
    tracemalloc.start()
    try:
        reader = FrameReader(1 << 30)
        assert reader.read(InPieces(head + bytes(1 << 20), 1 << 16)) is None
        assert tracemalloc.get_traced_memory()[1] < 8e6
    finally:
        tracemalloc.stop()


def test_what_arrived_before_the_limit_was_raised_is_kept():
    reader = FrameReader(100)
    small, large = pack(Kind.PROOF, b"abc", 1), pack(Kind.READY, bytes(3000), 2)
    stream = InPieces(small + large, 1 << 20)
    assert reader.read(stream).payload == b"abc"
    reader.limit = 5000
    assert reader.read(stream).payload == bytes(3000)


@pytest.mark.parametrize("header", [(11, 1, 0, 0), (5, 99, 0, 0), (5, 1, 1, 0)])
def test_a_bad_header_is_refused_before_anything_is_allocated(header):
    here, there = socket.socketpair()
    with here, there:
        here.sendall(HEADER.pack(*header))
        with pytest.raises(ConnectionRefusedByPeerError, match="not a physx message"):
            FrameReader(10).read(there)


# Errors -----------------------------------------------------------------------------------------


def test_errors_come_back_as_what_they_were():
    error = FieldShapeError("wrong", field="x", instance_id=2, step=5)
    error.add_note("here")
    back = decode_error(encode_error(error))
    assert type(back) is FieldShapeError
    assert str(back) == str(error) == "Instance 2, step 5: wrong"
    assert vars(back) == vars(error)
    assert "FieldShapeError" in str(back.__cause__)
    back = decode_error(encode_error(UnknownOptionError("Thing", ["colour"], ["color"])))
    assert type(back) is UnknownOptionError
    assert (back.owner, back.unknown, back.known) == ("Thing", ["colour"], ["color"])


class PluginsOwnError(ConfigError):
    """Unknown where the server runs."""


def test_an_error_class_of_a_plugin_comes_back_as_its_base():
    error = PluginsOwnError("mine")
    error.thing = object()
    back = decode_error(encode_error(error))
    assert type(back) is ConfigError
    assert str(back) == "mine"
    assert vars(back) == {}


def test_a_message_in_many_parts_arrives_whole():
    """More parts than a system call takes, and more bytes than the connection does at once."""
    parts = [bytes([number % 251]) * (number % 7 * 1000) for number in range(1500)]
    received = bytearray()

    def receive():
        while len(received) < sum(map(len, parts)):
            received.extend(there.recv(1 << 20))

    here, there = socket.socketpair()
    with there:
        link = WorkerLink(here, FrameReader(100))
        thread = threading.Thread(target=receive)
        thread.start()
        link.send_parts(parts)
        thread.join()
        link.close()
    assert received == b"".join(parts)
