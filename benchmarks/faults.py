"""How fast a broken client is reported, and how fast clients leave a killed server.

Each fault happens several times, in real processes; the time is noted right before it. For a client
that breaks, what counts is the time until the error names it and says how it broke; if it only
falls silent, the allowed silence is subtracted. For a server that is killed, what counts is the
time until all its clients are gone.

    python benchmarks/faults.py
    python benchmarks/faults.py --check     # ends with status 1 if a target is missed
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import select
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from measure import claim, finish

from physx_core import Environment, EnvironmentConfig, Field, PhysxError
from physx_core.net import HEADER, Kind
from physx_core.observers import Observers
from physx_core.pipelines.services import RunServices
from physx_core.sources import ClientSource

ROUNDS = 5
CLIENTS = 2
SILENCE = 2.0
LONGEST = 60.0
TARGET = 2.0
ROWS_BEFORE = 50
NOTE, LIFE = "broke", "life"

_SILENT = f"Client 2 sent nothing for {SILENCE:g} s.*last words"
BROKEN = {
    "raises": ("raise_error", "Instance 2 raised in step.*no more beans.*in raise_error"),
    "exits": ("leave", "Client 2 ended with exit status 3.*last words"),
    "is killed with -9": ("kill", r"Client 2 was killed by signal 9 \(SIGKILL\).*last words"),
    "sends garbage": ("send_garbage", "Client 2 was cut off.*not a physx message.*last words"),
    "disconnects": ("disconnect", "Client 2 closed the connection.*last words"),
    "is stopped": ("stop", _SILENT),
    "never ends its step": ("spin", _SILENT),
    "sends a frame slowly": ("trickle", _SILENT),
}
LEFT_BEHIND = {
    "its clients are well": "go_on",
    "a client is stopped": "stop",
    "a client is in a call that lets no Python run": "hold",
}


class Breaking(Environment):
    """Breaks in its second instance after some rows; it notes the time right before."""

    def __init__(self, *, fault: str, folder: str, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.fault, self.folder = fault, Path(folder)

    def create(self) -> None:
        """Hold the pipe whose closing shows that every client is gone."""
        self.life = os.open(self.folder / LIFE, os.O_WRONLY)
        os.write(self.life, b"x")

    def init_database(self) -> None:
        """Define a field."""
        self.define_training_fields(Field("x", ()))

    def step(self) -> None:
        """Set a number after a millisecond, or break."""
        time.sleep(1e-3)
        if self.instance_id == 2 and self.step_index == ROWS_BEFORE:
            print("last words", file=sys.stderr, flush=True)
            note = self.folder / f"{NOTE}.new"
            note.write_text(str(time.monotonic()))  # a clock that all processes share
            note.rename(self.folder / NOTE)
            getattr(self, self.fault)()
        self.set_training_data(x=np.float64(self.step_index))

    def go_on(self) -> None:
        """Do nothing."""

    def raise_error(self) -> None:
        """Raise an error."""
        raise RuntimeError("no more beans")

    def leave(self) -> None:
        """End the process immediately."""
        os._exit(3)

    def kill(self) -> None:
        """Kill this process."""
        os.kill(os.getpid(), signal.SIGKILL)

    def stop(self) -> None:
        """Stop this process."""
        os.kill(os.getpid(), signal.SIGSTOP)

    def spin(self) -> None:
        """Compute forever."""
        while True:
            pass

    def hold(self) -> None:
        """Wait forever, without letting other Python threads run."""
        ctypes.PyDLL(None).pause()

    def send_garbage(self) -> None:
        """Send bytes that are not a message, and wait."""
        connection_of_this_client().sendall(bytes(range(1, 256)) * 20)
        time.sleep(LONGEST)

    def disconnect(self) -> None:
        """Close the connection, but keep the process."""
        connection_of_this_client().shutdown(socket.SHUT_RDWR)
        time.sleep(LONGEST)

    def trickle(self) -> None:
        """Send a long message little by little."""
        connection = connection_of_this_client()
        connection.sendall(HEADER.pack(1_000_000, Kind.ROWS, 0, 1))
        while True:
            connection.sendall(bytes(200))
            time.sleep(0.1)


def connection_of_this_client() -> socket.socket:
    """Return the connection to the server: the only open file that is connected."""
    for number in range(3, 256):
        with contextlib.suppress(OSError):
            found = socket.socket(fileno=os.dup(number))
            found.getpeername()
            found.setblocking(True)
            return found
    raise RuntimeError("there is no connection")


@contextlib.contextmanager
def life_of_clients(folder: Path) -> Iterator[int]:
    """Create the pipe that clients hold as long as they live; yield the end to read."""
    os.mkfifo(folder / LIFE)
    pipe = os.open(folder / LIFE, os.O_RDONLY | os.O_NONBLOCK)
    try:
        yield pipe
    finally:
        os.close(pipe)


def when_all_are_gone(pipe: int) -> float:
    """Wait until no client holds the pipe; return the time."""
    if os.read(pipe, CLIENTS) != b"x" * CLIENTS:
        raise RuntimeError("Not every client came to life.")
    if not select.select([pipe], [], [], LONGEST)[0]:
        raise RuntimeError(f"A client is still there after {LONGEST:g} s.")
    return time.monotonic()


def clients(fault: str, folder: Path) -> ClientSource:
    """Return clients, one of which breaks."""
    config = EnvironmentConfig(
        Breaking,
        env_kwargs={"fault": fault, "folder": str(folder)},
        num_clients=CLIENTS,
        seed=0,
        timeout=SILENCE if fault in ("stop", "spin", "trickle") else LONGEST,
    )
    return ClientSource(config, RunServices(folder, Observers([]), None), [0, 0, 0])


def produce(source: ClientSource) -> NoReturn:
    """Have clients generate rows forever."""
    while True:
        source.batch(20)


def broken_client(fault: str, pattern: str, folder: Path) -> tuple[float, float]:
    """Return the s from a client's failure to its error, and until all clients are gone.

    Args:
        fault: What the client does.
        pattern: A pattern that the error matches.
        folder: An empty folder.
    """
    with life_of_clients(folder) as pipe:
        with clients(fault, folder) as source:
            try:
                produce(source)
            except PhysxError as error:
                named = time.monotonic()
                told = str(error) + getattr(error, "remote_traceback", "")
        gone = when_all_are_gone(pipe)
    if not re.search(pattern, told, re.DOTALL):
        raise RuntimeError(f"The error does not say how the client broke: {told}")
    broke = float((folder / NOTE).read_text()) + (SILENCE if pattern == _SILENT else 0.0)
    return named - broke, gone - broke


def killed_server(fault: str, folder: Path) -> float:
    """Return the s from killing a server with -9 until all its clients are gone.

    Args:
        fault: What a client does before that.
        folder: An empty folder.
    """
    with life_of_clients(folder) as pipe:
        with subprocess.Popen([sys.executable, __file__, fault, str(folder)]) as server:
            until = time.monotonic() + LONGEST
            while not (folder / NOTE).exists():
                if server.poll() is not None or time.monotonic() > until:
                    server.kill()
                    raise RuntimeError("The server did not get as far as the fault.")
                time.sleep(1e-3)
            killed = time.monotonic()
            server.kill()
        return when_all_are_gone(pipe) - killed


def measure() -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Return the s until each error, and the s until all clients were gone."""
    named: dict[str, list[float]] = {name: [] for name in BROKEN}
    gone: dict[str, list[float]] = {name: [] for name in (*BROKEN, *LEFT_BEHIND)}
    for _ in range(ROUNDS):
        for name, (fault, pattern) in BROKEN.items():
            with tempfile.TemporaryDirectory() as folder:
                error, all_gone = broken_client(fault, pattern, Path(folder))
            named[name].append(error)
            gone[name].append(all_gone)
        for name, fault in LEFT_BEHIND.items():
            with tempfile.TemporaryDirectory() as folder:
                gone[name].append(killed_server(fault, Path(folder)))
    return named, gone


def in_words(seconds: list[float]) -> str:
    """Return median and maximum as text."""
    return f"{statistics.median(seconds):.3f} s, at most {max(seconds):.3f} s"


def main() -> None:
    """Measure and print."""
    named, gone = measure()
    met = []
    for name in BROKEN:
        print(f"A client {name}")
        print(f"  the error is there after {in_words(named[name])}")
        print(f"  all clients are gone after {in_words(gone[name])}, without a target")
        met.append(claim("s until the error", statistics.median(named[name]), at_most=TARGET))
    for name in LEFT_BEHIND:
        print(f"The server is killed with -9, {name}")
        print(f"  all clients are gone after {in_words(gone[name])}")
        met.append(claim("s until then", statistics.median(gone[name]), at_most=TARGET))
    finish(met)


if __name__ == "__main__":
    if len(sys.argv) == 3:  # the server to be killed
        with clients(sys.argv[1], Path(sys.argv[2])) as source:
            produce(source)
    main()
