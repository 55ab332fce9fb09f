"""Process that computes rows of batches for another one: ``python -m physx_dart.batch.worker``.

It receives the models once, then requests for rows. The rows and the results are in memory that
both processes map. It exits when the other process closes the connection or ends.
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

from physx_core.engines import Resistance
from physx_core.typing import Vector
from physx_dart.pinocchio.algorithms import MoverAlgorithms, PinocchioAlgorithms

FORWARD, GRADIENTS = range(2)
REQUEST = struct.Struct("<4q")
"""`FORWARD` or `GRADIENTS`; rows of the batch; the first to compute, and the first after those."""
DONE = b"."
"""Reply to each request."""


class SharedRows:
    """Rows of states and results in a file that several processes map; it grows as needed.

    Attributes:
        file: Descriptor of the file.
    """

    def __init__(self, file: int, nq: int, nv: int) -> None:
        """Map nothing yet.

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
    """Return a line of text from which `algorithms_of` rebuilds them; it contains no code."""
    movers = [
        (each.model.saveToString(), each.resistance.table.tolist()) for each in algorithms.movers
    ]
    return json.dumps(movers).encode("ascii") + b"\n"


def algorithms_of(line: bytes) -> PinocchioAlgorithms:
    """Return the algorithms, without bodies, that a line of `describe_models` describes."""
    movers = []
    for text, table in json.loads(line):
        model = pinocchio.Model()
        model.loadFromString(text)
        movers.append(MoverAlgorithms(model, Resistance(np.array(table).reshape(5, model.nv))))
    return PinocchioAlgorithms(movers, np.zeros((0, 7)))


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
