"""EnvSliceEnvironment: a slice of a vector environment's environments, in a client of a run."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from physx_core import Environment, Field
from physx_core.net import Kind, decode, decode_error
from physx_core.typing import Batch
from physx_gym.vector.batch import COMMAND
from physx_gym.vector.env_slice import EnvSlice
from physx_gym.vector.rows import ROW, RowLayout

ENTRIES, COUNT, ORDER, ORDER_SIZE = "entries", "count", "order", "order_size"
"""Names of the stored fields that hold a client's entries, and a command, with their lengths."""


class EnvSliceEnvironment(Environment):
    """An environment whose steps execute entries from the vector environment, as a worker does.

    What it sends besides the results are the parameters that it saves.
    """

    def __init__(self, *, setup: Mapping[str, Any], **kwargs: Any) -> None:
        """Store what to run.

        Args:
            setup: What the vector environment runs, with its ``shares``.
            kwargs: See `Environment`.
        """
        super().__init__(**kwargs)
        self._setup = {**setup, "number": self.instance_id - 1}
        self._messages: list[tuple[Kind, bytes, int]] = []

    def create(self) -> None:
        """Create the environments."""
        setup = self._setup
        shares: Sequence[int] = setup["shares"]
        number = setup["number"]
        seen, given = ([Field.from_dict(f) for f in setup[n]] for n in ("observations", "actions"))
        has_finals = AutoresetMode(setup["autoreset"]) is AutoresetMode.SAME_STEP
        self._layout = RowLayout(seen, max(shares), has_finals=has_finals)
        self._row = np.zeros(self._layout.field.shape or (), np.uint8)
        count = shares[number]
        self._actions: Batch = {f.name: np.zeros((count, *(f.shape or ())), f.dtype) for f in given}
        whole = self._row[: count * self._layout.dtype.itemsize]
        arrays = self._layout.arrays(whole, self._actions, sum(shares[:number]))
        sys.path += [each for each in setup["path"] if each not in sys.path]
        self._slice = EnvSlice(setup, arrays, lambda *message: self._messages.append(message))
        self._slice.create()
        self._report()

    def init_database(self) -> None:
        """Define the row."""
        self.define_training_fields([self._layout.field])

    def step(self) -> None:
        """Execute entries."""
        told = self.sample or {}
        for name, array in self._actions.items():
            array[:] = told[name][: len(array)]
        for entry in told[ENTRIES][: int(told[COUNT])].tolist():
            if entry == COMMAND:
                self._slice.execute(decode(told[ORDER][: int(told[ORDER_SIZE])].tobytes()))
            else:
                self._slice.step(entry)
        self._report()
        self.set_training_data(**{ROW: self._row})

    def close(self) -> None:
        """Close the environments."""
        if hasattr(self, "_slice"):
            self._slice.close()
            for kind, content, _ in self._messages:
                if kind is Kind.ERROR:
                    raise decode_error(content)

    def _report(self) -> None:
        """Send the messages."""
        if self._messages:
            sent = [
                [int(kind), np.frombuffer(content, np.uint8), number]
                for kind, content, number in self._messages
            ]
            self._messages.clear()
            self.save_parameters(messages=sent)
