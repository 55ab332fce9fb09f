"""LearnedSets: the parameters that a sampler chooses while it learns from a training."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from physx_core.components.parameter import Parameter
from physx_core.components.sampler import LearningSampler, checked
from physx_core.typing import Array, Index
from physx_core.workers.row_queue import RowQueue


class _Told(NamedTuple):
    """The losses of a batch: numbers of its episodes, increasing, and their mean losses."""

    numbers: Index
    losses: Array


class _State(NamedTuple):
    next: int
    applied: int
    newest: int
    waiting: tuple[_Told, ...]
    values: dict[int, Mapping[str, Any]]
    sampler: Array


class LearnedSets:
    """Asks a sampler that learns for the parameters of episodes, in order of their numbers.

    Those of episode k depend on the losses of exactly the batches made only of rows of episodes
    before ``k - run_ahead``, so they are the same in every run, whoever simulates and however fast.
    They can be chosen once those episodes have ended and the network has learned from the batches.
    """

    def __init__(
        self,
        sampler: LearningSampler,
        parameters: Sequence[Parameter],
        needed: Callable[[int], int],
        batch_nb: int,
        run_ahead: int,
    ) -> None:
        """Start with episode 0.

        Args:
            sampler: Has begun.
            parameters: What it chooses.
            needed: Returns how many rows must have arrived before a batch; never decreases.
            batch_nb: Number of batches of the training.
            run_ahead: How many episodes may be simulated beyond the first missing one.
        """
        self._sampler, self._parameters = sampler, parameters
        self._needed, self._batch_nb, self._run_ahead = needed, batch_nb, run_ahead
        self._changed = threading.Condition()
        self._next = 0  # episode to choose for
        self._known = 0  # batches whose losses it may depend on
        self._applied = self._told = 0  # batches that the sampler, and this object, were told
        self._newest = -1  # episode with losses
        self._waiting: deque[_Told] = deque()  # what the sampler has not been told yet
        self._values: dict[int, Mapping[str, Any]] = {}
        self._before = self._state()

    def choose(self, queue: RowQueue, stop: int) -> int:
        """Choose for the numbers below `stop`, as far as possible; return the first one without.

        Args:
            queue: Knows which episodes have ended.
            stop: Nothing is chosen from this number on, as it may not be needed.
        """
        with self._changed:
            while self._next < stop and self._can_choose(queue):
                while self._applied < self._known:
                    self._apply()
                values = self._sampler.ask(self._next)
                self._values[self._next] = checked(self._parameters, values)
                self._next += 1
            self._forget(min(self._newest - self._sampler.memory, queue.missing - 1))
            return self._next

    def values_of(self, number: int) -> Mapping[str, Any]:
        """Return the parameters chosen for an episode that may still be simulated."""
        return self._values[number]

    def tell(self, numbers: Index, losses: Array) -> None:
        """Learn from the next training batch.

        Args:
            numbers: Numbers of the episodes of the batch's rows.
            losses: Losses of these rows.
        """
        found, places = np.unique(numbers, return_inverse=True)
        means = np.bincount(places, losses) / np.bincount(places)
        with self._changed:
            self._before = self._state()
            self._waiting.append(_Told(found, means))
            self._told += 1
            self._changed.notify_all()

    def wait(self, timeout: float) -> None:
        """Wait until another batch is told, at most `timeout` s."""
        with self._changed:
            told = self._told
            self._changed.wait_for(lambda: self._told > told, timeout)

    def state(self, batches: int) -> Array:
        """Return what `restore` needs after some batches, shape (n,).

        Args:
            batches: Number of batches: all that were told, or all but the last one.
        """
        with self._changed:
            state = self._before if batches < self._told else self._state()
        told = [np.concatenate([[len(n)], n, losses]) for n, losses in state.waiting]
        chosen = [
            np.concatenate([[number], *(np.ravel(values[p.name]) for p in self._parameters)])
            for number, values in state.values.items()
        ]
        head = [state.next, state.applied, state.newest, len(told), len(chosen)]
        return np.concatenate([head, *told, *chosen, state.sampler]).astype(np.float64)

    def restore(self, batches: int, state: Array) -> None:
        """Continue after some batches, before anything is chosen.

        Raises:
            ValueError: If `state` is not a state of this sampler.
        """
        rest = _Numbers(state)
        self._next, self._applied, self._newest, told, chosen = rest.take(5).astype(int).tolist()
        if self._applied + told != batches:
            raise ValueError("it is the state after other batches")
        for _ in range(told):
            count = int(rest.take(1)[0])
            self._waiting.append(_Told(rest.take(count).astype(np.int64), rest.take(count)))
        for _ in range(chosen):
            number = int(rest.take(1)[0])
            parts = {p.name: rest.take(p.size).reshape(p.shape) for p in self._parameters}
            typed = {p.name: parts[p.name].astype(p.field.numpy_dtype) for p in self._parameters}
            self._values[number] = checked(self._parameters, typed)
        self._sampler.restore(rest.left)
        self._told = batches
        self._before = self._state()

    def _can_choose(self, queue: RowQueue) -> bool:
        """Return whether the network has learned from all that the next set depends on."""
        if self._next - self._run_ahead > queue.missing:
            return False
        rows = queue.rows_before(self._next - self._run_ahead)
        while self._known < self._batch_nb and self._needed(self._known) <= rows:
            self._known += 1
        return self._known <= self._told

    def _apply(self) -> None:
        """Tell the sampler the next losses, of episodes that are not too old."""
        numbers, losses = self._waiting.popleft()
        self._newest = max(self._newest, int(numbers[-1]))
        recent = numbers > self._newest - self._sampler.memory
        values = [self._values[number] for number in numbers[recent].tolist()]
        self._sampler.tell(numbers[recent], values, losses[recent])
        self._applied += 1

    def _forget(self, until: int) -> None:
        while self._values and (oldest := next(iter(self._values))) <= until:
            del self._values[oldest]

    def _state(self) -> _State:
        return _State(
            self._next,
            self._applied,
            self._newest,
            tuple(self._waiting),
            dict(self._values),
            self._sampler.state(),
        )


class _Numbers:
    """Numbers to take from the front."""

    def __init__(self, numbers: Array) -> None:
        self.left = np.asarray(numbers, np.float64)

    def take(self, count: int) -> Array:
        """Return the next numbers.

        Raises:
            ValueError: If there are not so many.
        """
        if not 0 <= count <= len(self.left) or not np.isfinite(self.left[:count]).all():
            raise ValueError("it is the state of a sampler with other options or parameters")
        taken, self.left = self.left[:count], self.left[count:]
        return taken
