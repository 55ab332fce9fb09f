"""A rogue that sends frames to a server, random and mutated, and prints what it did as JSON.

``python rogue_client.py HOST:PORT INSTANCE SEED FRAMES``; instance 0: it does not prove that it
knows the token in ``PHYSX_TOKEN``, whatever it sends; otherwise it does, and sends the frames in
the place of that instance. Every connection ends after some frames, or when the server ends it.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import socket
import struct
import sys
import time

import numpy as np

from physx_core import Field
from physx_core.errors import ConfigError, ConnectionRefusedByPeerError
from physx_core.net import HEADER, Kind, encode, encode_error, introduce, pack
from physx_core.rows import ROW_FIELDS

FIELDS = [Field("x", shape=(2,)), Field("flag", shape=(), dtype="bool")]
EDGES = [0, 1, 2, 3, 255, 2**15, 2**16, 2**30, 2**31, 2**32 - 1, 2**63, 2**64 - 1]
TEXTS = [
    "[" * 30_000,
    '{"t":' * 3000 + "1" + "}" * 3000,
    '{"d":[[{"d":[]},1]]}',
    '{"a":["|S0",[1099511627776],0]}',
    '{"a":["<f8",[0,4611686018427387904,4611686018427387904],0]}',
    '{"a":["<f8",[-1,-1],8]}',
    '{"a":["(((f8",[1],8]}',
    '{"a":["<M8[99999999999999s]",[1],8]}',
    '{"b":-5}',
    '{"c":[]}',
    '{"i":"0x' + "f" * 5000 + '"}',
    "9" * 5000,
    "1e999999",
    '{"p":"\\u0000"}',
    '{"u":"\\ud800"}',
    '{"flat":[["x","<f8",[1099511627776]]]}',
    '{"flat":[["x","<f8","python"],["x","<f8",[1,2,3]]]}',
    '{"flat":[[["x"],"|O",[1]]]}',
    "[" + "[],{}," * 2000 + "1]",
]


def plain(kind, value, number=0):
    return pack(kind, encode(value), number)


class Insider:
    """What a client sends that knows the token."""

    def __init__(self, rng, instance):
        self.rng, self.instance = rng, instance
        self.requests = 0
        self.steps = time.monotonic_ns()  # those of later connections are higher
        self.table = [field.to_dict() for field in FIELDS]

    def frames(self):
        """The frames of one connection; most are as a client sends them."""
        rng = self.rng
        opening = [self.ready(), self.fields()]
        further = [self.some_frame() for _ in range(rng.randrange(1, 16))]
        if rng.random() < 0.2:
            frames = [mutated(rng, rng.choice([*opening, *further])), *further]
        elif rng.random() < 0.1:
            frames = [opening[0], mutated(rng, opening[1]), *further]
        else:
            share = rng.choice([0.05, 0.5])
            frames = opening + [
                mutated(rng, frame) if rng.random() < share else frame for frame in further
            ]
        return frames

    def ready(self):
        return plain(Kind.READY, self.table)

    def fields(self):
        return plain(Kind.FIELDS, [*self.table, *(field.to_dict() for field in ROW_FIELDS)])

    def some_frame(self):
        makes = [self.rows, self.rows, self.show, self.ask, self.ask]
        seldom = [self.ready, self.fields, self.error, self.bye]
        return self.rng.choice(seldom if self.rng.random() < 0.05 else makes)()

    def rows(self):
        count = self.rng.randrange(1, 5)
        payload = (
            np.full((count, 2), self.rng.choice([0.0, 1.5, 1e300])).tobytes()
            + bytes(self.rng.randrange(2) for _ in range(count))
            + np.full(count, self.instance, "<i4").tobytes()
            + np.zeros(count, "<i8").tobytes()
            + np.arange(self.steps, self.steps + count).astype("<i8").tobytes()
        )
        self.steps += count
        return pack(Kind.ROWS, payload, count)

    def show(self):
        events = [("add", "mesh", ("a",), {"positions": np.zeros((2, 3), "f4"), "color": "red"})]
        return plain(Kind.SHOW, events, self.rng.randrange(9))

    def ask(self):
        self.requests += 1
        kind = self.rng.choice([Kind.PREDICT, Kind.SAVE, Kind.LOAD])
        number = self.rng.choice([1, 2**70, [1, [2]], "a", None])
        values = {"x": np.ones(self.rng.randrange(3)), "n": number}
        if self.rng.random() < 0.5:
            del values["n"]
        return plain(kind, None if kind is Kind.LOAD else values, self.requests)

    def error(self):
        return pack(Kind.ERROR, encode_error(ConfigError("no")), self.rng.randrange(5))

    def bye(self):
        return pack(Kind.BYE)


def flipped(rng, payload):
    payload = bytearray(payload)
    for _ in range(rng.randrange(1, 6)):
        place = rng.randrange(len(payload) + 1)
        change = rng.randrange(4)
        if change == 0 and place < len(payload):
            payload[place] = rng.choice([*b'[]{}",:0129-.eE<|fiMSU', rng.randrange(256)])
        elif change == 1:
            payload[place:place] = rng.randbytes(rng.randrange(1, 9))
        elif change == 2:
            del payload[place : place + rng.randrange(1, 9)]
        elif place < len(payload):
            payload[place] ^= 1 << rng.randrange(8)
    return bytes(payload)


def mutated(rng, frame):
    """A frame with something wrong in it."""
    length, kind, spare, number = HEADER.unpack_from(frame)
    payload = frame[HEADER.size :]
    change = rng.randrange(10)
    if change == 0:
        return HEADER.pack(length, rng.randrange(1 << 16), spare, number) + payload
    if change == 1:
        return HEADER.pack(length, kind, spare, rng.choice(EDGES)) + payload
    if change == 2:
        return HEADER.pack(rng.choice(EDGES[:10]), kind, spare, number) + payload
    if change == 3:
        return HEADER.pack(length, kind, rng.randrange(1 << 16), number) + payload
    if change == 4:
        return frame[: rng.randrange(len(frame))]
    if change == 5:
        return rng.randbytes(rng.randrange(1, 200))
    if change == 6:
        text = rng.choice(TEXTS).encode()
        payload = struct.pack("<I", rng.choice([len(text), *EDGES[:10]])) + text + bytes(8)
    elif change == 7:
        payload = rng.randbytes(rng.randrange(300))
    else:
        payload = flipped(rng, payload)
    kind = rng.choice(list(Kind)) if rng.random() < 0.1 else kind
    return HEADER.pack(len(payload), kind, 0, number) + payload


def stranger(rng):
    """What somebody sends who does not know the token."""
    hello = pack(Kind.HELLO, struct.pack("<8sI32s", b"physxtcp", 1, rng.randbytes(32)))
    proof = pack(Kind.PROOF, rng.randbytes(32), rng.choice(EDGES))
    choice = rng.randrange(8)
    if choice == 0:
        return [hello, proof]
    if choice == 1:
        return [hello, mutated(rng, proof)]
    if choice == 2:
        return [hello, hello]
    if choice == 3:
        return [Insider(rng, 1).some_frame()]
    if choice == 4:
        return [rng.randbytes(rng.randrange(400))]
    return [mutated(rng, hello)]


def attack(address, instance, rng, most):
    """Send frames in one connection; return how many were sent, at most `most`."""
    frames = (Insider(rng, instance).frames() if instance else stranger(rng))[:most]
    sent = 0
    with socket.create_connection(address, timeout=60) as connection:
        # No connection of the many is kept by the operating system once it is closed.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        reader = introduce(connection, os.environ["PHYSX_TOKEN"], instance) if instance else None
        with contextlib.suppress(OSError, EOFError):
            for frame in frames:
                connection.sendall(frame)
                sent += 1
                if reader is not None and sent == 1:
                    # Not for long: the first frame may be wrong.
                    wait_for(Kind.CREDIT, connection, reader, 0.005)
                elif reader is not None and rng.random() < 0.03:
                    wait_for(Kind.ANSWER, connection, reader, 0.02)
            if rng.random() < 0.9:  # let the server read it all before the connection is cut
                connection.shutdown(socket.SHUT_WR)
                while connection.recv(1 << 16):
                    pass
    return sent


def wait_for(kind, connection, reader, seconds):
    """Read what the server sends until a frame of a kind comes, or nothing for some seconds."""
    connection.settimeout(seconds)
    with contextlib.suppress(EOFError):  # as a timeout is told too
        while (frame := reader.read(connection)) and frame.kind is not kind:
            pass
    connection.settimeout(20)


def main(place, instance, seed, total):
    host, _, port = place.rpartition(":")
    rng = random.Random(seed)
    sent = connections = refused = 0
    began = time.monotonic()
    while sent < total:
        try:
            sent += attack((host, int(port)), instance, rng, total - sent)
            connections += 1
        except (OSError, ConnectionRefusedByPeerError):
            refused += 1
            time.sleep(0.001)
    seconds = time.monotonic() - began
    print(
        json.dumps(
            {"frames": sent, "connections": connections, "refused": refused, "seconds": seconds}
        )
    )


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
