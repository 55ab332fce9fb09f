"""ClientWorkers: shares of a vector environment in clients that a launcher starts."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from physx_core import EnvironmentConfig, Field
from physx_core.errors import PhysxError, UsageError
from physx_core.net import Frame, Kind, decode_error, encode
from physx_core.sources import ClientSource
from physx_core.typing import Array, Batch
from physx_gym.vector.batch import COMMAND, SharedBatch
from physx_gym.vector.env_slice_environment import COUNT, ENTRIES, ORDER, ORDER_SIZE
from physx_gym.vector.rows import ROW, RowLayout, copy_results
from physx_gym.vector.worker_group import WorkerGroup

_ENVIRONMENT = "physx_gym.vector.env_slice_environment:EnvSliceEnvironment"


class ClientWorkers(WorkerGroup):
    """Clients of a run, in place of processes that share memory.

    Entries are sent when their results are awaited: all requested ones, in one message to each
    client.
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
        shares: Sequence[int] = setup["shares"]
        super().__init__(len(shares))
        self._batch = batch
        self._most = max(shares)
        fields = [Field.from_dict(each) for each in setup["observations"]]
        self._layout = RowLayout(fields, self._most, has_finals=bool(batch.finals))
        starts = np.cumsum([0, *shares]).tolist()
        self._slices = [slice(*pair) for pair in pairwise(starts)]
        self._queues: list[list[int]] = [[] for _ in shares]
        self._orders = [b""] * len(shares)
        self._done = [0] * len(shares)
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
        """Add entries to the queue of a worker: see `WorkerGroup.ask`."""
        self._queues[number] += np.asarray(entries).tolist()
        self.asked[number] += len(entries)

    def command(self, name: str, arguments: Sequence[Any]) -> list[Any]:
        """Have each worker execute a command after its other entries: see `WorkerGroup.command`."""
        orders = [encode({"name": name, "arguments": each}, name) for each in arguments]
        self.wait(sum(self.asked))
        self._orders = orders
        for number in range(len(arguments)):
            self.ask(number, [COMMAND])
        try:
            self.wait(sum(self.asked), is_step=False)
        finally:
            answers = self._take_answers()
        return answers

    def wait(self, entries: int, *, is_step: bool = True) -> list[int]:
        """Wait until the workers have finished some entries: see `WorkerGroup.wait`."""
        if sum(self._done) < entries:
            self._execute()
        self._raise(is_step=is_step)
        return list(self._done)

    def _end(self, orderly: bool) -> None:
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
