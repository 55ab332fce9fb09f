"""Workers: the processes of a vector environment, from start to exit."""

from __future__ import annotations

import contextlib
import select
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from physx_core.errors import ClientError
from physx_core.net import (
    MAX_PAYLOAD,
    FrameReader,
    Kind,
    decode_error,
    encode,
    fence,
    has_core_for_each,
    order,
    pack,
)
from physx_core.processes import WorkerProcess
from physx_core.typing import Array
from physx_gym.vector.batch import COMMAND, END, NEVER, SharedBatch
from physx_gym.vector.spinning import Spinner
from physx_gym.vector.worker_group import WorkerGroup

_WAKEUP = pack(Kind.ACTIONS)
_TICK = 0.1
_LAST_WORDS_TIME = 0.3
_EXIT_TIME = 5.0
_GRACE = 0.5
_MAKE_TIME = 60.0
"""Shortest time limit for processes to create their environments, and to close them, in s."""


class Workers(WorkerGroup):
    """Processes that share memory with this one."""

    def __init__(
        self, batch: SharedBatch, file: int, setup: Mapping[str, Any], timeout: float
    ) -> None:
        """Start the processes, and wait until all environments have been created.

        Args:
            batch: The shared memory.
            file: Its descriptor.
            setup: What the workers run, with their ``shares``.
            timeout: Longest time that an entry may take, in s.
        """
        self._batch, self._timeout = batch, max(timeout, _MAKE_TIME)
        self._shares: Sequence[int] = setup["shares"]
        super().__init__(len(self._shares))
        self._workers: list[_Worker] = []
        self._by_file: dict[int, int] = {}
        self._poll = select.poll()
        spins = has_core_for_each(len(self._shares) + 1)  # including this process
        self._spinner = Spinner(spins=spins)
        self._received = [0] * len(self._shares)
        batch.awaited[0] = NEVER
        path = [str(Path(entry).resolve()) for entry in sys.path]
        shared = {**setup, "path": path}
        messages = [
            _message({**shared, "number": n}, "env_kwargs") for n in range(len(self._shares))
        ]
        try:
            for number in range(len(self._shares)):
                self._workers.append(worker := _Worker(number, file))
                self._by_file[worker.process.link.fileno()] = number
                self._poll.register(worker.process.link, select.POLLIN)
            for number, message in enumerate(messages):
                self.ask(number, [COMMAND])  # to create the environments
                self._send(number, message)
            self.wait(sum(self.asked))
        except BaseException:
            self.close(orderly=False)
            raise
        self._timeout = timeout

    def ask(self, number: int, entries: Sequence[int] | Array) -> None:
        """Add entries to the queue of a worker: see `WorkerGroup.ask`."""
        batch, start = self._batch, self.asked[number] % self._batch.capacity
        queue, count = batch.queues[number], len(entries)
        fitting = min(count, batch.capacity - start)
        queue[start : start + fitting] = entries[:fitting]
        if fitting < count:
            queue[: count - fitting] = entries[fitting:]
        self.asked[number] += count
        order()
        batch.asked[number] = self.asked[number]
        fence()
        if batch.idle[number]:
            self._workers[number].wake()

    def command(self, name: str, arguments: Sequence[Any]) -> list[Any]:
        """Have each worker execute a command: see `WorkerGroup.command`."""
        messages = [_message({"name": name, "arguments": each}, name) for each in arguments]
        self.wait(sum(self.asked))  # a worker that sends something may not receive
        for number, message in enumerate(messages):
            self.ask(number, [COMMAND])
            self._send(number, message)
        try:
            self.wait(sum(self.asked), is_step=False)
        finally:
            answers = self._take_answers()
        return answers

    def wait(self, entries: int, *, is_step: bool = True) -> list[int]:
        """Wait until the workers have finished some entries: see `WorkerGroup.wait`."""
        batch = self._batch

        def is_done() -> bool:
            return sum(batch.done) >= entries

        if not (is_done() or self._spinner.find(is_done)):
            batch.awaited[0] = entries
            fence()
            try:
                self._sleep(is_done)
            finally:
                batch.awaited[0] = NEVER
        done = list(batch.done)
        order()
        # Not by their sums: a message may be read before it is counted.
        for number, sent in enumerate(batch.sent):
            is_read = sent <= self._received[number] or self._receive(number)
            if not is_read and done[number] < self.asked[number]:
                self._fail(self._end_of(number))
        self._raise(is_step=is_step)
        return done

    def close(self, *, orderly: bool) -> None:
        """End the processes: see `WorkerGroup.close`."""
        try:
            super().close(orderly=orderly)
        finally:
            for worker in self._workers:
                worker.process.link.close()

    def _sleep(self, is_done: Callable[[], bool]) -> None:
        """Sleep until something is done; detect workers that exit or hang."""
        batch = self._batch
        seen, since = list(batch.done), [time.monotonic()] * len(self._workers)
        looked = since[0]
        while not is_done():
            for file, _ in self._poll.poll(1000 * _TICK):
                if not self._receive(number := self._by_file[file]) and not is_done():
                    self._fail(self._end_of(number))
            now = time.monotonic()
            if now - looked < _TICK:
                continue
            looked = now
            for number, done in enumerate(batch.done):
                if done != seen[number]:
                    seen[number], since[number] = done, now
                elif done != self.asked[number] and now - since[number] > self._timeout:
                    self._fail(self._silence_of(number))

    def _receive(self, number: int) -> bool:
        """Read what a worker has sent; return whether the link is still open."""
        worker = self._workers[number]
        with contextlib.suppress(EOFError):
            while (frame := worker.reader.read(worker.process.link)) is not None:
                if frame.kind is Kind.READY:  # it only woke this process
                    continue
                self._received[number] += 1
                if frame.kind is Kind.ERROR:
                    self._errors.setdefault(frame.number, decode_error(frame.payload))
                else:
                    self.messages.append((number, frame))
            return True
        return False

    def _send(self, number: int, message: bytes) -> None:
        """Send a worker a message that it is waiting for."""
        link = self._workers[number].process.link
        link.settimeout(self._timeout)
        try:
            link.sendall(message)
        except TimeoutError:
            self._fail(self._silence_of(number))
        except OSError:
            self._fail(self._end_of(number))
        link.setblocking(False)

    # Ends -----------------------------------------------------------------------------------

    def _end(self, orderly: bool) -> None:
        """Ask the processes to exit, and kill those that do not."""
        running = set(range(len(self._workers)))
        self._timeout = max(self._timeout, _MAKE_TIME) if orderly else _GRACE
        until = time.monotonic() + self._timeout
        try:
            for number, worker in enumerate(self._workers):
                self._batch.asked[number] = END
                worker.wake()
            while running and time.monotonic() < until:
                for file, _ in self._poll.poll(1000 * _TICK):
                    if not self._receive(number := self._by_file[file]):
                        self._poll.unregister(file)
                        running.discard(number)
            if running and orderly:
                raise self._silence_of(min(running))
            for worker in self._workers:
                worker.process.wait(_EXIT_TIME if orderly else 0.0)
        finally:
            for worker in self._workers:
                worker.process.ask_to_end()
            for worker in self._workers:
                worker.process.close(_LAST_WORDS_TIME)

    def _end_of(self, number: int) -> ClientError:
        """Return the error for a worker that has exited."""
        process, doing = self._workers[number].process, self._describe_entry(number)
        how, text = process.describe_end(_EXIT_TIME), process.stderr(_LAST_WORDS_TIME)
        status = process.exit_status()
        return ClientError(number + 1, f"{how} {doing}.", exit_status=status, stderr=text)

    def _silence_of(self, number: int) -> ClientError:
        """Return the error for a worker whose entry takes too long."""
        process, doing = self._workers[number].process, self._describe_entry(number)
        process.ask_to_end()  # it then writes where it was
        process.wait(_LAST_WORDS_TIME)
        text = (
            f"sent nothing for {self._timeout:g} s {doing}. If it needs more time, raise timeout."
        )
        return ClientError(number + 1, text, stderr=process.stderr(_LAST_WORDS_TIME))

    def _describe_entry(self, number: int) -> str:
        done = self._batch.done[number]
        first, count = sum(self._shares[:number]), self._shares[number]
        mine = (
            f"environment {first}" if count == 1 else f"environments {first} to {first + count - 1}"
        )
        if not self.is_open:
            return f"while closing {mine}"
        if not done:
            return f"while creating {mine}"
        if done == self.asked[number]:
            return f"while waiting, with {mine}"
        entry = int(self._batch.queues[number][done % self._batch.capacity])
        return f"in a call of {mine}" if entry == COMMAND else f"in environment {first + entry}"


def _message(value: Mapping[str, Any], what: str) -> bytes:
    return pack(Kind.REQUEST, encode(value, what))


class _Worker:
    """A worker's process, and what reads its frames.

    Attributes:
        process: The process; its link does not block.
        reader: Reads the frames.
    """

    def __init__(self, number: int, file: int) -> None:
        """Start the process.

        Args:
            number: Number of the worker.
            file: Descriptor of the shared memory.
        """
        try:
            self.process = WorkerProcess("physx_gym.vector.worker", file, pass_fds=[file])
        except OSError as error:
            raise ClientError(number + 1, f"could not be started: {error}.") from error
        self.process.link.setblocking(False)
        self.reader = FrameReader(MAX_PAYLOAD)

    def wake(self) -> None:
        """Wake the worker if it sleeps."""
        with contextlib.suppress(OSError):  # it is gone, or already has something to wake up for
            self.process.link.send(_WAKEUP)
