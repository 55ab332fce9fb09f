"""Raw TCP between two processes: the baseline for the clients in transport.py."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator

_RAW_CLIENT = """
import os, socket, sys
port, size, what = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
if len(sys.argv) > 4:
    os.sched_setaffinity(0, {int(sys.argv[4])})
connection = socket.create_connection(("127.0.0.1", port))
connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
message, buffer, number = bytes(size), memoryview(bytearray(size)), bytearray(8)
while connection.recv_into(number) == 8:
    for _ in range(int.from_bytes(number, "little")):
        connection.sendall(message)
        received = 0 if what == "ask" else size
        while received < size:
            received += connection.recv_into(buffer[received:])
"""


@contextlib.contextmanager
def raw_client(size: int, what: str, core: int | None = None) -> Iterator[socket.socket]:
    """Yield the connection to a process that sends as many messages as it is told to.

    Args:
        size: Length of each message in bytes.
        what: ``ask``: it waits for an answer to each; ``stream``: it does not.
        core: The only processor core that it may use; None: any.
    """
    with socket.create_server(("127.0.0.1", 0)) as listener:
        options = [listener.getsockname()[1], size, what, *([] if core is None else [core])]
        process = subprocess.Popen([sys.executable, "-c", _RAW_CLIENT, *map(str, options)])
        connection, _ = listener.accept()
    with connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield connection
    process.wait()


def raw_answers(connection: socket.socket, size: int, count: int) -> int:
    """Answer `count` messages."""
    message, buffer = bytes(size), memoryview(bytearray(size))
    connection.sendall(count.to_bytes(8, "little"))
    for _ in range(count):
        received = 0
        while received < size:
            received += connection.recv_into(buffer[received:])
        connection.sendall(message)
    return count


def raw_stream(connection: socket.socket, size: int, count: int) -> int:
    """Read `count` messages in blocks of 256 kB."""
    for _ in raw_blocks(connection, size, count):
        pass
    return count


def raw_blocks(connection: socket.socket, size: int, count: int) -> Iterator[memoryview]:
    """Read `count` messages; yield each block of at most 256 kB, valid until the next one."""
    buffer, missing = memoryview(bytearray(1 << 18)), size * count
    connection.sendall(count.to_bytes(8, "little"))
    while missing:
        received = connection.recv_into(buffer, min(missing, len(buffer)))
        missing -= received
        yield buffer[:received]
