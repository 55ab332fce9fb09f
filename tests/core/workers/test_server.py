"""The server among strangers: handshake, wrong tokens, addresses and ports."""

from __future__ import annotations

import os
import socket
import threading
import time

import pytest

from physx_core.errors import ConfigError, ConnectionRefusedByPeerError
from physx_core.net import HEADER, Kind, introduce, pack
from physx_core.workers.client.worker import run_client

pytestmark = pytest.mark.processes


def test_unauthenticated_connections_do_not_disturb_run(clients, port):
    stop_it = threading.Event()
    talked = []

    def stranger(first, listen):
        while not stop_it.is_set():
            try:
                with socket.create_connection(("127.0.0.1", port), timeout=1) as connection:
                    connection.sendall(first)
                    talked.append(1)
                    if listen:
                        connection.recv(1000)
                    stop_it.wait(0.001 if listen else 0.3)
            except OSError:
                stop_it.wait(0.01)

    hello = pack(Kind.HELLO, b"physxtcp" + bytes(36))
    strangers = [
        threading.Thread(target=stranger, args=args)
        for args in (
            (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", True),
            (os.urandom(500), True),
            (HEADER.pack(0xFFFFFFFF, 1, 0, 0), True),
            (hello[:20], False),
            (hello, False),
            (hello + pack(Kind.PROOF, bytes(32), 1), True),
            (pack(Kind.ROWS, bytes(100), 5), True),
            (b"", False),
        )
    ]
    for thread in strangers:
        thread.start()
    try:
        with clients(num_clients=2, port=port) as source:
            deadline = time.monotonic() + 60
            row = 0
            while len(talked) <= 8 and time.monotonic() < deadline:
                assert list(source.batch(2)["x"][:, 1]) == [row, row]
                row += 1
    finally:
        stop_it.set()
        for thread in strangers:
            thread.join()
    assert len(talked) > 8


def test_client_with_wrong_token_is_refused(clients, port):
    errors = []

    def join():
        with pytest.raises(ConnectionRefusedByPeerError) as caught:
            run_client(f"127.0.0.1:{port}", "wrong" * 10)
        errors.append(str(caught.value))

    with clients(port=port) as source:
        thread = threading.Thread(target=join)
        thread.start()
        while thread.is_alive():
            source.batch(1)
            time.sleep(0.011)
    assert "does not know this client's token" in errors[0]
    assert "PHYSX_TOKEN" in errors[0]


def test_a_client_does_not_trust_a_server_without_the_token():
    answers = [
        b"",
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        pack(Kind.CHALLENGE, b"physxtcp" + (1).to_bytes(4, "little") + bytes(64)),
        pack(Kind.CHALLENGE, b"physxtcp" + (9).to_bytes(4, "little") + bytes(64)),
        pack(Kind.SETUP, bytes(50)),
        pack(Kind.CHALLENGE, b"x"),
    ]
    for answer in answers:
        here, there = socket.socketpair()
        with here, there:
            there.sendall(answer)
            if not answer:
                there.close()
            with pytest.raises(ConnectionRefusedByPeerError):
                introduce(here, "token" * 5, 1)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nonsense", "127.0.0.1:port", "a.invalid:80"])
def test_connection_refused_names_address(address):
    with pytest.raises(ConnectionRefusedByPeerError, match=address):
        run_client(address, "token" * 5, patience=1.0)


def test_a_port_in_use_is_named(clients):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with (
            pytest.raises(ConfigError, match=rf"127\.0\.0\.1 port {port}.*port=0"),
            clients(port=port),
        ):
            pass


def test_an_address_of_another_machine_is_named(clients):
    with pytest.raises(ConfigError, match=r"192\.0\.2\.1"), clients(ip_address="192.0.2.1"):
        pass


def test_all_addresses_of_the_machine_can_be_listened_at(clients, monkeypatch):
    monkeypatch.setenv("PHYSX_TOKEN", "a token for this test")
    with clients(ip_address="0.0.0.0") as source:
        assert source.batch(1)["step"] == [0]
