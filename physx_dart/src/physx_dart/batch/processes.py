"""Batched forward dynamics, computed by several processes in parallel.

Pinocchio's derivatives hold Python's global interpreter lock, so threads cannot run them in
parallel.
"""

from __future__ import annotations

import contextlib
import os
import weakref
from collections.abc import Sequence

import numpy as np

from physx_core.processes import WorkerProcess, anonymous_file
from physx_core.typing import Vector
from physx_dart.batch.worker import (
    DONE,
    FORWARD,
    GRADIENTS,
    REQUEST,
    SharedRows,
    compute,
    describe_models,
)
from physx_dart.pinocchio.algorithms import MovableAlgorithms, PinocchioAlgorithms
from physx_sim.errors import SimulationError

_LEAST_ROWS = 16
"""Minimum number of rows for which an additional process pays off."""


class ParallelAlgorithms(PinocchioAlgorithms):
    """Algorithms that split the rows of a batch between this process and others.

    The other processes start on first use. They end when this object is closed or garbage
    collected, and when this process ends, even if it is killed. A process forked from this one
    computes all rows itself.
    """

    def __init__(self, movables: Sequence[MovableAlgorithms], statics: Vector) -> None:
        """Combine movables with static bodies, whose poses have the shape (statics, 7)."""
        super().__init__(movables, statics)
        self._owner = os.getpid()
        self._workers: list[_Worker] = []
        self._memory: SharedRows | None = None
        self._held = contextlib.ExitStack()
        weakref.finalize(self, _end_processes, self._held, self._owner)

    def forward_batch(self, q: Vector, v: Vector, tau: Vector, processes: int = 1) -> Vector:
        """Return `forward_dynamics` for many states, shape (n, nv)."""
        shares = self._shares(processes, len(q))
        if shares < 2:
            return super().forward_batch(q, v, tau)
        return self._compute(FORWARD, (q, v, tau), shares)

    def gradients_batch(
        self, q: Vector, v: Vector, a: Vector, weights: Vector, processes: int = 1
    ) -> Vector:
        """Return gradients of weighted sums of the accelerations, shape (3, n, nv)."""
        shares = self._shares(processes, len(q))
        if shares < 2:
            return super().gradients_batch(q, v, a, weights)
        return self._compute(GRADIENTS, (q, v, a, weights), shares)

    def close(self) -> None:
        """End the other processes; the next batch that needs them starts new ones."""
        self._workers, self._memory = [], None
        _end_processes(self._held, self._owner)

    def _shares(self, processes: int, rows: int) -> int:
        """Return the number of processes to share the rows."""
        return min(processes, rows // _LEAST_ROWS) if os.getpid() == self._owner else 1

    def _compute(self, kind: int, states: tuple[Vector, ...], shares: int) -> Vector:
        try:
            return self._compute_shared(kind, states, shares)
        except BaseException:  # there may be pending replies that nobody is waiting for
            self.close()
            raise

    def _compute_shared(self, kind: int, states: tuple[Vector, ...], shares: int) -> Vector:
        """Return the results of all rows; each process computes a share, this one the first."""
        rows = len(states[0])
        ends = [rows * share // shares for share in range(1, shares + 1)]
        mine = ends[0]
        workers, memory = self._start_workers(shares - 1)
        given, results = memory.arrays(kind, rows)
        for target, each in zip(given, states, strict=True):
            target[mine:] = each[mine:]
        for worker, begin, end in zip(workers, ends[:-1], ends[1:], strict=True):
            worker.ask(REQUEST.pack(kind, rows, begin, end))
        found = np.empty(results.shape)
        found[..., :mine, :] = compute(self, kind, tuple(x[:mine] for x in states))
        for worker in workers:
            worker.wait()
        found[..., mine:, :] = results[..., mine:, :]
        return found

    def _start_workers(self, count: int) -> tuple[list[_Worker], SharedRows]:
        """Return `count` other processes and their shared memory."""
        if self._memory is None:
            file = self._held.enter_context(anonymous_file("physx_batches"))
            self._memory = SharedRows(file.fileno(), self.nq, self.nv)
        new = [_Worker(self._memory.file, self._held) for _ in range(count - len(self._workers))]
        for worker in new:
            worker.ask(describe_models(self))
        self._workers += new
        return self._workers[:count], self._memory


class _Worker:
    """A process that computes rows."""

    def __init__(self, file: int, held: contextlib.ExitStack) -> None:
        """Start the process.

        Args:
            file: Descriptor of the shared memory.
            held: Stack that ends the process when it is closed.
        """
        try:
            self._process = WorkerProcess("physx_dart.batch.worker", file, pass_fds=[file])
        except OSError as error:
            raise SimulationError(f"Cannot start a process for batches: {error}.") from error
        held.callback(self._process.close)

    def ask(self, message: bytes) -> None:
        """Send a message."""
        try:
            self._process.link.sendall(message)
        except ConnectionError:
            raise self._lost() from None

    def wait(self) -> None:
        """Wait until the process has finished its request."""
        with contextlib.suppress(ConnectionError):
            if self._process.link.recv(len(DONE)) == DONE:
                return
        raise self._lost()

    def _lost(self) -> SimulationError:
        return SimulationError(
            f"A process that computed rows of a batch (pid {self._process.pid}) "
            f"{self._process.describe_end()}. The next batch starts a new one; processes=1 needs "
            f"none.\n{self._process.stderr()}".rstrip()
        )


def _end_processes(held: contextlib.ExitStack, owner: int) -> None:
    """End processes and free their memory; a forked process leaves this to its parent."""
    if os.getpid() == owner:
        held.close()
