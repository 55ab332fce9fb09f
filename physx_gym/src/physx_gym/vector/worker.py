"""Worker of a vector environment: ``python -m physx_gym.vector.worker LINK MEMORY``.

It receives what to run, then steps its share of the environments in the order of its queue: see
`SharedBatch`. Commands, errors, and infos that do not fit are sent as messages over the link. It
exits when the process with the vector environment tells it to, or is gone.
"""

from __future__ import annotations

import contextlib
import select
import socket
import sys
from collections import deque
from collections.abc import Mapping
from typing import Any

from gymnasium.vector import AutoresetMode

from physx_core import Field
from physx_core.net import (
    MAX_PAYLOAD,
    FrameReader,
    Kind,
    decode,
    fence,
    has_core_for_each,
    order,
    pack,
)
from physx_core.processes import kill_descendants, prepare_worker
from physx_gym.vector.batch import COMMAND, END, SharedBatch
from physx_gym.vector.env_slice import EnvSlice
from physx_gym.vector.spinning import Spinner

_WAKEUP = pack(Kind.READY)
_LOOK_EVERY = 1000  # ms


class Worker:
    """Executes the entries of its queue, in order."""

    def __init__(self, link: socket.socket, file: int) -> None:
        """Receive what to run.

        Args:
            link: Connection to the process with the vector environment.
            file: Descriptor of the shared memory.
        """
        self._link, self._reader = link, FrameReader(MAX_PAYLOAD)
        self._poll = select.poll()
        self._poll.register(link, select.POLLIN)
        self._commands: deque[Mapping[str, Any]] = deque()
        setup = self._command()
        tables = [[Field.from_dict(each) for each in setup[n]] for n in ("observations", "actions")]
        has_finals = AutoresetMode(setup["autoreset"]) is AutoresetMode.SAME_STEP
        self._batch = SharedBatch(file, setup["shares"], *tables, has_finals=has_finals)
        self._number = setup["number"]
        self._queue = memoryview(self._batch.queues[self._number])
        self._done = 0
        self._spinner = Spinner(spins=has_core_for_each(len(setup["shares"])))
        sys.path[:] = setup["path"]
        self._slice = EnvSlice(setup, self._batch, self._send)

    def run(self) -> None:
        """Create the environments, and step them until told to exit."""
        share = self._slice
        try:
            share.create()
            self._finish()
            while (entry := self._next()) is not None:
                if entry == COMMAND:
                    share.execute(self._command())
                else:
                    share.step(entry)
                self._finish()
        finally:
            share.close()

    def _next(self) -> int | None:
        """Wait for the next entry, and return it; None at the end."""
        asked = self._batch.asked[self._number]
        if asked == self._done:
            asked = self._wait()
        if asked == END:
            return None
        order()
        return int(self._queue[self._done % self._batch.capacity])

    def _wait(self) -> int:
        """Wait until there are entries to execute; return how many there have been in total."""
        asked, number, done = self._batch.asked, self._number, self._done

        def has_more() -> bool:
            return bool(asked[number] != done)

        if not self._spinner.find(has_more):
            self._batch.idle[number] = 1
            fence()
            while not has_more():
                if self._poll.poll(_LOOK_EVERY):
                    self._receive()
            self._batch.idle[number] = 0
        return int(asked[number])

    def _finish(self) -> None:
        """Report that an entry is done."""
        batch = self._batch
        self._done += 1
        order()
        batch.done[self._number] = self._done
        fence()
        if sum(batch.done) >= batch.awaited[0]:
            self._link.sendall(_WAKEUP)

    def _send(self, kind: Kind, content: bytes, number: int) -> None:
        self._link.sendall(pack(kind, content, number))
        self._batch.sent[self._number] += 1

    def _command(self) -> Mapping[str, Any]:
        """Wait for the next command, and return it."""
        while not self._commands:
            self._receive()
        return self._commands.popleft()

    def _receive(self) -> None:
        """Read at least one message; keep commands, as others only wake this process."""
        while True:
            frame = self._reader.read(self._link)
            if frame is not None and frame.kind is Kind.REQUEST:
                self._commands.append(decode(frame.payload))
            if not self._reader.has_buffered:
                return


def main() -> None:
    """Run the worker with the arguments from the command line."""
    prepare_worker(preempts=True)  # else each step waits for the slice of a busy process
    try:
        with contextlib.suppress(EOFError, ConnectionError):  # the other process is gone
            Worker(socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2])).run()
    finally:
        kill_descendants()


if __name__ == "__main__":
    main()
