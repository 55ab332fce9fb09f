"""WorkerGroup: what executes the entries of a vector environment's queues, wherever it runs."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NoReturn

from physx_core.errors import PhysxError
from physx_core.net import Frame, Kind, decode
from physx_core.typing import Array


class WorkerGroup(ABC):
    """Workers with a queue each; if one of them fails, all are ended.

    Attributes:
        is_open: Whether they execute entries.
        asked: For each worker, how many entries its queue has had.
        messages: What workers sent besides their results and errors: their numbers, and frames.
    """

    def __init__(self, count: int) -> None:
        """Begin with empty queues.

        Args:
            count: Number of workers.
        """
        self.is_open, self.asked = True, [0] * count
        self.messages: list[tuple[int, Frame]] = []
        self._owner = os.getpid()
        self._errors: dict[int, PhysxError] = {}

    @abstractmethod
    def ask(self, number: int, entries: Sequence[int] | Array) -> None:
        """Add entries to the queue of a worker."""

    @abstractmethod
    def command(self, name: str, arguments: Sequence[Any]) -> list[Any]:
        """Have each worker execute a command after its other entries.

        Args:
            name: Name of the command.
            arguments: The argument for each worker.

        Returns:
            The answer of each worker; None if it has none.

        Raises:
            UsageError: If the arguments cannot be sent.
        """

    @abstractmethod
    def wait(self, entries: int, *, is_step: bool = True) -> list[int]:
        """Wait until the workers together have finished a number of entries since the start.

        Args:
            entries: The number.
            is_step: Whether an environment that raises ends the workers.

        Returns:
            For each worker, how many it has finished.

        Raises:
            ClientError: If a worker ends, or an entry takes too long.
            PhysxError: If environments raise: the error of the first one.
        """

    def close(self, *, orderly: bool) -> None:
        """End the workers; none is left when this returns.

        Args:
            orderly: Whether to wait until they have closed their environments, and raise what these
                raise; otherwise they get only a moment to do so.
        """
        if not self.is_open:
            return
        self.is_open = False
        if os.getpid() == self._owner:  # a forked process leaves them alone
            self._end(orderly)
        if orderly:
            self._raise(is_step=False)

    @abstractmethod
    def _end(self, orderly: bool) -> None:
        """End the workers: see `close`."""

    def _take_answers(self) -> list[Any]:
        """Return the answer of each worker to a command; they are no longer among the messages."""
        answers = {n: decode(f.payload) for n, f in self.messages if f.kind is Kind.ANSWER}
        self.messages = [(n, f) for n, f in self.messages if f.kind is not Kind.ANSWER]
        return [answers.get(number) for number in range(len(self.asked))]

    def _raise(self, *, is_step: bool) -> None:
        """Raise the error of the first environment that sent one; that of a step ends all."""
        if self._errors:
            error = self._errors[min(self._errors)]
            self._errors.clear()
            if is_step:
                self._fail(error)
            raise error

    def _fail(self, error: PhysxError) -> NoReturn:
        self.close(orderly=False)
        raise error
