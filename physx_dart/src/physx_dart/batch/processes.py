"""Batches whose rows several processes share.

Pinocchio's derivatives hold Python's global lock, so that only processes compute them side by side.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import weakref
from typing import IO

import numpy as np

from physx_core import Closeable
from physx_core.errors import SimulationError
from physx_core.typing import Vector
from physx_dart.batch.batches import Batches
from physx_dart.batch.worker import (
    DONE,
    FORWARD,
    GRADIENTS,
    REQUEST,
    SharedRows,
    computed,
    described,
)

_LEAST_ROWS = 16
"""Rows of a batch for which a process is worth waking."""
_PATIENCE = 5.0
"""Time in s for which a process that closed its connection may take to end."""


class SharedBatches(Closeable):
    """Batches of which this process computes some rows, and others the rest at the same time.

    The other processes start when they are first needed. They end when this is closed or no longer
    used, and when this process ends, whatever ends it. A process forked from this one computes all
    rows itself.
    """

    def __init__(self, batches: Batches) -> None:
        self._batches = batches
        self._owner = os.getpid()
        self._workers: list[_Worker] = []
        self._memory: SharedRows | None = None
        self._held = contextlib.ExitStack()
        weakref.finalize(self, _let_go, self._held, self._owner)

    def forward(self, q: Vector, v: Vector, tau: Vector, *, processes: int) -> Vector:
        """Return the accelerations, shape (n, nv).

        Raises:
            SimulationError: One of the processes ended.
        """
        return self._computed(FORWARD, (q, v, tau), processes)

    def gradients(
        self, q: Vector, v: Vector, a: Vector, weights: Vector, *, processes: int
    ) -> Vector:
        """Return the gradients of weighted sums of the accelerations, shape (3, n, nv).

        Raises:
            SimulationError: One of the processes ended.
        """
        return self._computed(GRADIENTS, (q, v, a, weights), processes)

    def close(self) -> None:
        """End the other processes; a batch that needs them starts new ones."""
        self._workers, self._memory = [], None
        _let_go(self._held, self._owner)

    def _computed(self, kind: int, states: tuple[Vector, ...], processes: int) -> Vector:
        shares = min(processes, len(states[0]) // _LEAST_ROWS)
        if shares < 2 or os.getpid() != self._owner:
            return computed(self._batches, kind, states)
        try:
            return self._shared(kind, states, shares)
        except BaseException:  # answers may be on their way that nobody waits for
            self.close()
            raise

    def _shared(self, kind: int, states: tuple[Vector, ...], shares: int) -> Vector:
        """Return the results of all rows; each process computes one share, this one the first."""
        rows = len(states[0])
        ends = [rows * share // shares for share in range(1, shares + 1)]
        mine = ends[0]
        workers, memory = self._started(shares - 1)
        given, results = memory.arrays(kind, rows)
        for target, each in zip(given, states, strict=True):
            target[mine:] = each[mine:]
        for worker, begin, end in zip(workers, ends[:-1], ends[1:], strict=True):
            worker.ask(REQUEST.pack(kind, rows, begin, end))
        found = np.empty(results.shape)
        found[..., :mine, :] = computed(self._batches, kind, tuple(x[:mine] for x in states))
        for worker in workers:
            worker.wait()
        found[..., mine:, :] = results[..., mine:, :]
        return found

    def _started(self, count: int) -> tuple[list[_Worker], SharedRows]:
        """Return so many of the other processes, and what they share."""
        if self._memory is None:
            file = self._held.enter_context(_anonymous_file())
            self._memory = SharedRows(file.fileno(), self._batches.nq, self._batches.nv)
        new = [_Worker(self._memory.file, self._held) for _ in range(count - len(self._workers))]
        for worker in new:
            worker.ask(described(self._batches))
        self._workers += new
        return self._workers[:count], self._memory


class _Worker:
    """One of the other processes."""

    def __init__(self, file: int, held: contextlib.ExitStack) -> None:
        """Start it.

        Args:
            file: Descriptor of the memory that it shares.
            held: Ends it when it is closed.

        Raises:
            SimulationError: The operating system refused.
        """
        self._link, theirs = socket.socketpair()
        held.enter_context(self._link)
        command = [sys.executable, "-P", "-m", "physx_dart.batch.worker", str(file)]
        # The processes share the cores: a numerical library must not take all for each.
        environment = {"OMP_NUM_THREADS": "1", **os.environ}
        with theirs:
            try:
                self._process = subprocess.Popen(
                    command,
                    stdin=theirs.fileno(),
                    env=environment,
                    pass_fds=[file],
                    start_new_session=True,
                )
            except OSError as error:
                raise SimulationError(f"A process for batches cannot start: {error}.") from error
        held.callback(self._process.wait)
        held.callback(self._process.kill)

    def ask(self, message: bytes) -> None:
        """Send a message.

        Raises:
            SimulationError: The process ended.
        """
        try:
            self._link.sendall(message)
        except ConnectionError:
            raise self._lost() from None

    def wait(self) -> None:
        """Wait until it has done what it was asked.

        Raises:
            SimulationError: The process ended.
        """
        with contextlib.suppress(ConnectionError):
            if self._link.recv(len(DONE)) == DONE:
                return
        raise self._lost()

    def _lost(self) -> SimulationError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_PATIENCE)
        status, how = self._process.returncode, "closed its connection"
        if status is not None:
            how = f"ended with exit status {status}"
            if status < 0:
                how = f"was ended by signal {-status} ({signal.strsignal(-status)})"
        return SimulationError(
            f"A process that computed rows of a batch (pid {self._process.pid}) {how}; its "
            "standard error may say why. The next batch starts a new one; processes=1 needs none."
        )


def _let_go(held: contextlib.ExitStack, owner: int) -> None:
    """End processes and free what they share; a forked process leaves this to its parent."""
    if os.getpid() == owner:
        held.close()


def _anonymous_file() -> IO[bytes]:
    """Return a file without a name, in memory where the system has such."""
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("physx_batches"), "r+b", buffering=0)
    return tempfile.TemporaryFile(buffering=0)
