"""Many clients in one process that simulate nothing, to measure what a server spends on each.

many_clients.py HOST:PORT CLIENTS VALUES ROWS: each client sends as many rows of VALUES numbers as
it may, ROWS in a frame.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import sys
import time

import numpy as np

from physx_core import Field
from physx_core.net import (
    FrameReader,
    Kind,
    encode,
    encrypt,
    introduce,
    pack,
    pack_header,
    parse_address,
)
from physx_core.rows import ROW_FIELDS


class Client:
    """A connection, with the number of rows that it may send and has sent."""

    def __init__(self, address: str, number: int, fields: list[Field]) -> None:
        self.number, self.fields, self.sent, self.allowed = number, fields, 0, 0
        connected = socket.create_connection(parse_address(address), 60.0)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket = encrypt(connected)
        self.reader: FrameReader = introduce(self.socket, os.environ["PHYSX_TOKEN"], number)
        self.socket.settimeout(None)
        assert self.next() is Kind.SETUP
        self.tell(Kind.READY, fields)
        self.tell(Kind.FIELDS, [*fields, *ROW_FIELDS])

    def tell(self, kind: Kind, fields: list[Field]) -> None:
        """Send fields."""
        self.socket.sendall(pack(kind, encode([field.to_dict() for field in fields])))

    def next(self) -> Kind:
        """Wait for a message, and return its kind."""
        frame = self.reader.read(self.socket)
        assert frame is not None
        if frame.kind is Kind.CREDIT:
            self.allowed = frame.number
        return frame.kind

    def send_rows(self, count: int) -> None:
        """Send a frame of rows, including the columns that number them."""
        columns = [np.zeros((count, *(field.shape or ()))) for field in self.fields]
        steps = np.arange(self.sent, self.sent + count)
        numbers = {"env_id": np.full(count, self.number), "episode": np.zeros(count), "step": steps}
        for field in ROW_FIELDS:
            columns.append(numbers[field.name].astype(field.dtype))
        payload = b"".join(column.tobytes() for column in columns)
        self.socket.sendall(pack_header(Kind.ROWS, len(payload), count) + payload)
        self.sent += count


def connect(address: str, number: int, fields: list[Field]) -> Client:
    """Connect as soon as the server listens."""
    until = time.monotonic() + 60
    while True:
        try:
            return Client(address, number, fields)
        except ConnectionRefusedError:
            if time.monotonic() > until:
                raise
            time.sleep(0.02)


def main() -> None:
    """Connect all clients, and send rows until the server ends."""
    address, clients, values, rows = sys.argv[1], *map(int, sys.argv[2:])
    fields = [Field("x", (values - values // 6,)), Field("y", (values // 6,))]
    selector = selectors.DefaultSelector()
    for number in range(1, clients + 1):
        client = connect(address, number, fields)
        selector.register(client.socket, selectors.EVENT_READ, client)
    with contextlib.suppress(OSError, EOFError):
        while True:
            for key, _ in selector.select():
                client = key.data
                while client.next() is Kind.CREDIT and client.reader.has_buffered:
                    pass
                while client.sent < client.allowed:
                    client.send_rows(min(rows, client.allowed - client.sent))


if __name__ == "__main__":
    main()
