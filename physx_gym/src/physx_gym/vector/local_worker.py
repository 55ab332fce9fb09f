"""LocalWorker: a vector environment's only environment, in this process."""

from __future__ import annotations

import traceback
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from physx_core.errors import EnvironmentFailedError
from physx_core.net import Frame, Kind, decode, decode_error, encode
from physx_core.typing import Array
from physx_gym.vector.batch import SharedBatch
from physx_gym.vector.env_slice import EnvSlice
from physx_gym.vector.worker_group import WorkerGroup


class LocalWorker(WorkerGroup):
    """One worker without a process: nothing could be computed at the same time.

    Entries are executed when their results are awaited.
    """

    def __init__(self, batch: SharedBatch, setup: Mapping[str, Any]) -> None:
        """Create the environment.

        Args:
            batch: Its arrays.
            setup: What to run.
        """
        super().__init__(1)
        self._queue: list[int] = []
        self._done = 0
        # What is given and returned is copied, as it is by a process.
        plain = decode(bytearray(encode({**setup, "number": 0}, "env_kwargs")))
        self._slice = EnvSlice(plain, batch, self._take)
        try:
            self._slice.create()
        except BaseException as error:
            self._interrupt(error, "__init__")
        self._raise(is_step=True)

    def ask(self, number: int, entries: Sequence[int] | Array) -> None:
        """Add entries to the queue: see `WorkerGroup.ask`."""
        self._queue.extend(entries)
        self.asked[number] += len(entries)

    def command(self, name: str, arguments: Sequence[Any]) -> list[Any]:
        """Execute a command after the other entries: see `WorkerGroup.command`."""
        command = decode(bytearray(encode({"name": name, "arguments": arguments[0]}, name)))
        self.wait(self.asked[0])
        try:
            self._slice.execute(command)
        except BaseException as error:
            self._interrupt(error, name)
        answers = self._take_answers()
        self._raise(is_step=False)
        return answers

    def wait(self, entries: int, *, is_step: bool = True) -> list[int]:
        """Execute entries until a number of them is done: see `WorkerGroup.wait`."""
        if self._done < entries:
            queue, self._queue = self._queue, []
            try:
                for entry in queue:
                    self._slice.step(entry)
            except BaseException as error:
                self._interrupt(error, "step")
            self._done += len(queue)
            self._raise(is_step=is_step)
        return [self._done]

    def _end(self, orderly: bool) -> None:
        self._slice.close()

    def _take(self, kind: Kind, content: bytes, number: int) -> None:
        if kind is Kind.ERROR:
            self._errors.setdefault(number, decode_error(bytearray(content)))
        else:
            self.messages.append((0, Frame(kind, number, bytearray(content))))

    def _interrupt(self, error: BaseException, method: str) -> NoReturn:
        """Close the environment, which the user interrupts, or whose own code exits the process."""
        if isinstance(error, SystemExit):
            text = "".join(traceback.format_exception(error))
            summary = f"SystemExit: {error.code}"
            self._fail(EnvironmentFailedError(1, method, -1, summary, text))
        self.close(orderly=False)
        raise error
