"""Speaks the protocol of external/program as docs/external.md describes it: wire.py [SEED].

With a seed, some bytes of what it says are wrong.
"""

import os
import random
import socket
import struct
import sys

FLOAT64 = ord("f") * 256 + 8


def header(kind, arrays, size):
    return b"phy\1" + struct.pack("<HHQ", kind, arrays, size)


def description(name, wanted, shape):
    axes = [*shape, *[0] * (8 - len(shape))]
    return struct.pack("<52sIiI8q", name, FLOAT64, len(shape), wanted, *axes)


def spoken(scale):
    """Return what follows the answer to the request for parameters."""
    said = b""
    for step in range(3):
        data = struct.pack("<3d", *(scale * step + axis for axis in range(3)))
        said += header(3, 1, len(data)) + description(b"x", 0, [3]) + data
    return said + header(5, 0, 0)


def damaged(said, seed):
    chance = random.Random(seed)
    said = bytearray(said)
    for _ in range(chance.choice([1, 3, 30])):
        said[chance.randrange(len(said))] = chance.randrange(256)
    return said[: chance.choice([len(said), chance.randrange(len(said))])]


with socket.socket(socket.AF_UNIX) as run:
    run.connect(os.environ["PHYSX_SOCKET"])
    run.sendall(header(1, 1, 0) + description(b"x", 1, [3]))
    run.sendall(header(2, 1, 0) + description(b"scale", 1, []))
    answer = run.recv(24, socket.MSG_WAITALL)
    assert answer[:16] == header(6, 1, 8)
    said = spoken(*struct.unpack("<d", answer[16:]))
    run.sendall(damaged(said, int(sys.argv[1])) if len(sys.argv) > 1 else said)
