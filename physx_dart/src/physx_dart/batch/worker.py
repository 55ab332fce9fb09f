"""Computes rows of batches for another process: ``python -m physx_dart.batch.worker``.

This process receives the models once, then requests for rows. Rows and results are in memory mapped
by both processes. It exits when the other process closes the connection or ends.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import socket
import struct
import sys

import numpy as np
import pinocchio

from physx_core.typing import Vector
from physx_dart.pinocchio.algorithms import MovableAlgorithms, PinocchioAlgorithms
from physx_sim.engines import Resistance

FORWARD, GRADIENTS = range(2)
REQUEST = struct.Struct("<4q")
"""`FORWARD` or `GRADIENTS`; rows in the batch; first row to compute, and the row after the last."""
DONE = b"."
"""The reply to each request."""


class SharedRows:
    """Rows of states and results in a file mapped by several processes, which grows as needed.

    Attributes:
        file: Descriptor of the file.
    """

    def __init__(self, file: int, nq: int, nv: int) -> None:
        """Store the arguments; `arrays` maps the file.

        Args:
            file: Descriptor of the file; it must stay open.
            nq: Length of the positions.
            nv: Length of the velocities.
        """
        self.file, self._nq, self._nv = file, nq, nv
        self._numbers = np.empty(0)

    def arrays(self, kind: int, rows: int) -> tuple[tuple[Vector, ...], Vector]:
        """Return the arguments and the result of `compute` for a batch, as views of the file."""
        begin = rows * self._nq
        size = begin + 6 * rows * self._nv
        if size > len(self._numbers):
            if os.fstat(self.file).st_size < 8 * size:
                os.ftruncate(self.file, 8 * size)
            self._numbers = np.frombuffer(mmap.mmap(self.file, 8 * size), np.float64)
        positions = self._numbers[:begin].reshape(rows, self._nq)
        others = self._numbers[begin:size].reshape(6, rows, self._nv)
        if kind == FORWARD:
            return (positions, *others[:2]), others[3]
        return (positions, *others[:3]), others[3:]


def compute(algorithms: PinocchioAlgorithms, kind: int, states: tuple[Vector, ...]) -> Vector:
    """Return the accelerations, shape (n, nv), or the gradients, shape (3, n, nv), of states."""
    if kind == FORWARD:
        q, v, tau = states
        return algorithms.forward_batch(q, v, tau)
    q, v, a, weights = states
    return algorithms.gradients_batch(q, v, a, weights)


def describe_models(algorithms: PinocchioAlgorithms) -> bytes:
    """Return a line of text, free of code, from which `algorithms_of` rebuilds the algorithms."""
    movables = [
        (each.model.saveToString(), each.resistance.table.tolist()) for each in algorithms.movables
    ]
    return json.dumps(movables).encode("ascii") + b"\n"


def algorithms_of(line: bytes) -> PinocchioAlgorithms:
    """Return the algorithms, without bodies, described by a line from `describe_models`."""
    movables = []
    for text, table in json.loads(line):
        model = pinocchio.Model()
        model.loadFromString(text)
        movables.append(MovableAlgorithms(model, Resistance(np.array(table).reshape(5, model.nv))))
    return PinocchioAlgorithms(movables, np.zeros((0, 7)))


def serve(link: socket.socket, file: int) -> None:
    """Compute rows until the other process closes the connection.

    Args:
        link: Connection to the process with the batches.
        file: Descriptor of the shared memory.
    """
    with link, link.makefile("rb") as requests:
        line = requests.readline()
        if not line.endswith(b"\n"):
            return
        algorithms = algorithms_of(line)
        memory = SharedRows(file, algorithms.nq, algorithms.nv)
        while len(request := requests.read(REQUEST.size)) == REQUEST.size:
            kind, rows, begin, end = REQUEST.unpack(request)
            states, found = memory.arrays(kind, rows)
            mine = tuple(each[begin:end] for each in states)
            found[..., begin:end, :] = compute(algorithms, kind, mine)
            link.sendall(DONE)


if __name__ == "__main__":
    with contextlib.suppress(ConnectionError):  # the other process is gone
        serve(socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2]))
