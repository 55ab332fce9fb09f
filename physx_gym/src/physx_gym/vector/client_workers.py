"""ClientWorkers: shares of a vector environment in clients that a launcher starts."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from physx_core import EnvironmentConfig, Field
from physx_core.errors import PhysxError, UsageError
from physx_core.net import Frame, Kind, decode, decode_error, encode
from physx_core.sources import ClientSource
from physx_core.typing import Array, Batch
from physx_gym.vector.batch import COMMAND, SharedBatch
from physx_gym.vector.env_slice_environment import COUNT, ENTRIES, ORDER, ORDER_SIZE
from physx_gym.vector.rows import ROW, RowLayout, copy_results

_ENVIRONMENT = "physx_gym.vector.env_slice_environment:EnvSliceEnvironment"


class ClientWorkers:
    """The interface of `Workers`, with clients of a run in place of processes that share memory.

    Entries are sent when their results are awaited: all requested ones, in one message to each
    client.

    Attributes:
        is_open: Whether the clients are running.
        asked: For each worker, how many entries its queue has had.
        messages: What workers sent besides their results and errors: their numbers, and frames.
    """

    def __init__(
        self, batch: SharedBatch, setup: Mapping[str, Any], config: Mapping[str, Any]
    ) -> None:
        """Start the clients, and wait until all environments have been created.

        Args:
            batch: Arrays of all environments.
            setup: What the workers run, with their ``shares``.
            config: Options of `EnvironmentConfig`.
        """
        self._batch, self._owner = batch, os.getpid()
        shares: Sequence[int] = setup["shares"]
        self._most = max(shares)
        fields = [Field.from_dict(each) for each in setup["observations"]]
        self._layout = RowLayout(fields, self._most, has_finals=bool(batch.finals))
        starts = np.cumsum([0, *shares]).tolist()
        self._slices = [slice(*pair) for pair in pairwise(starts)]
        self._errors: dict[int, PhysxError] = {}
        self._queues: list[list[int]] = [[] for _ in shares]
        self._orders = [b""] * len(shares)
        self._done = [0] * len(shares)
        self.is_open = True
        self.asked = [0] * len(shares)
        self.messages: list[tuple[int, Frame]] = []
        path = [str(Path(entry).resolve()) for entry in sys.path]
        environment = EnvironmentConfig(
            _ENVIRONMENT,
            env_kwargs={"setup": {**setup, "path": path}},
            num_clients=len(shares),
            **config,
        )
        self._source = ClientSource(environment, _MessageSink(self._take), [0], run_ahead=0)
        try:
            self._source.open()
        except BaseException:
            self.close(orderly=False)
            raise
        self._raise(is_step=True)

    def ask(self, number: int, entries: Sequence[int] | Array) -> None:
        """Add entries to the queue of a worker."""
        self._queues[number] += np.asarray(entries).tolist()
        self.asked[number] += len(entries)

    def command(self, name: str, arguments: Sequence[Any]) -> list[Any]:
        """Have each worker execute a command after its other entries: see `Workers.command`."""
        orders = [encode({"name": name, "arguments": each}, name) for each in arguments]
        self.wait(sum(self.asked))
        self._orders = orders
        for number in range(len(arguments)):
            self.ask(number, [COMMAND])
        try:
            self.wait(sum(self.asked), is_step=False)
        finally:
            answers = {n: decode(f.payload) for n, f in self.messages if f.kind is Kind.ANSWER}
            self.messages = [(n, f) for n, f in self.messages if f.kind is not Kind.ANSWER]
        return [answers.get(number) for number in range(len(arguments))]

    def wait(self, entries: int, *, is_step: bool = True) -> list[int]:
        """Wait until the workers together have finished a number of entries: see `Workers.wait`."""
        if sum(self._done) < entries:
            self._execute()
        self._raise(is_step=is_step)
        return list(self._done)

    def close(self, *, orderly: bool) -> None:
        """End the clients; none is left when this returns.

        Args:
            orderly: Whether to raise what environments raise as they are closed.
        """
        if not self.is_open:
            return
        self.is_open = False
        if os.getpid() == self._owner:
            with contextlib.nullcontext() if orderly else contextlib.suppress(PhysxError):
                self._source.close()

    def _execute(self) -> None:
        """Have the workers execute their queues, and store the results."""
        room = max(map(len, self._queues))
        entries = np.zeros((len(self._queues), room), np.int64)
        for row, queue in zip(entries, self._queues, strict=True):
            row[: len(queue)] = queue
        longest = max(1, *map(len, self._orders))
        order = [np.frombuffer(each.ljust(longest, b"\0"), np.uint8) for each in self._orders]
        stored: Batch = {
            ENTRIES: entries,
            COUNT: np.array([len(queue) for queue in self._queues]),
            ORDER: np.array(order),
            ORDER_SIZE: np.array([len(each) for each in self._orders]),
            **{name: self._shares_of(array) for name, array in self._batch.actions.items()},
        }
        try:
            rows = self._source.batch(len(self._queues), stored)[ROW]
        except PhysxError as error:
            self._fail(error)
        except BaseException:
            self.close(orderly=False)
            raise
        for number, (row, mine) in enumerate(zip(rows, self._slices, strict=True)):
            size = (mine.stop - mine.start) * self._layout.dtype.itemsize
            copy_results(self._layout.arrays(row[:size], {}, mine.start), self._batch)
            self._done[number] = self.asked[number]
            self._queues[number] = []
        self._orders = [b""] * len(self._queues)

    def _shares_of(self, array: Array) -> Array:
        """Return a row for each client, with the values of its environments, padded with zeros."""
        found = np.zeros((len(self._slices), self._most, *array.shape[1:]), array.dtype)
        for row, mine in zip(found, self._slices, strict=True):
            row[: mine.stop - mine.start] = array[mine]
        return found

    def _take(self, instance_id: int, messages: Sequence[Any]) -> None:
        """Store the messages of a worker."""
        for kind, content, number in messages:
            frame = Frame(Kind(kind), number, bytearray(content))
            if frame.kind is Kind.ERROR:
                self._errors.setdefault(number, decode_error(frame.payload))
            else:
                self.messages.append((instance_id - 1, frame))

    def _raise(self, *, is_step: bool) -> None:
        """Raise the error of the first environment that sent one."""
        if self._errors:
            error = self._errors[min(self._errors)]
            self._errors.clear()
            if is_step:
                self._fail(error)
            raise error

    def _fail(self, error: PhysxError) -> NoReturn:
        self.close(orderly=False)
        raise error


class _MessageSink:
    """Services for the clients of the run: they receive messages."""

    def __init__(self, take: Any) -> None:
        self._take = take

    def save_parameters(self, instance_id: int, values: dict[str, Any]) -> None:
        """Receive the messages of a worker."""
        self._take(instance_id, values["messages"])

    def load_parameters(self, instance_id: int) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def predict(self, fields: Any) -> NoReturn:
        """Refuse."""
        raise UsageError("A vector environment has no network.")

    def touch(self, instance_id: int) -> Sequence[float]:
        """Do nothing."""
        return ()

    def show(self, instance_id: int, step: int, events: Any) -> None:
        """Draw nothing."""
