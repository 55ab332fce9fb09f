"""Samplers and buffers of which each has one mistake, and right ones."""

import contextlib

import numpy as np

from physx_core import Buffer, Sampler
from physx_core.components import LearningSampler


class Right(Sampler):
    def ask(self, number):
        return self.values(self.random(number).random(self.size))


class InOrder(Right):
    def begin(self, parameters, seed):
        super().begin(parameters, seed)
        self.own = np.random.default_rng(seed)

    def ask(self, number):
        return self.values(self.own.random(self.size))


class Unseeded(Right):
    def begin(self, parameters, seed):
        super().begin(parameters, seed)
        self.salt = np.random.default_rng().integers(1 << 30)

    def ask(self, number):
        return self.values(np.random.default_rng([number, self.salt]).random(self.size))


class OutOfBounds(Right):
    def ask(self, number):
        found = super().ask(number)
        return {**found, "stiffness": found["stiffness"] * 10}


class Incomplete(Right):
    def ask(self, number):
        found = super().ask(number)
        del found["cells"]
        return found


class Cached(Right):
    def begin(self, parameters, seed):
        super().begin(parameters, seed)
        self.known = {}

    def ask(self, number):
        if number not in self.known:
            self.known[number] = super().ask(number)
        return self.known[number]


class Learns(LearningSampler):
    """Moves with the sum of the losses, which it keeps for the last batches."""

    def begin(self, parameters, seed):
        super().begin(parameters, seed)
        self.sums = {0: 0.0}

    def tell(self, batches, numbers, values, losses):
        self.sums[batches] = self.sums[batches - 1] + float(np.sum(losses))

    def ask_after(self, number, batches):
        share = (self.random(number).random(self.size) + self.sums[batches]) % 1.0
        return self.values(share)

    def state(self, batches):
        return np.array([each for n in self.sums if n <= batches for each in (n, self.sums[n])])

    def restore(self, batches, state):
        pairs = np.asarray(state)
        if len(pairs) % 2 or pairs[-2] != batches:
            raise ValueError("it is the state after other batches")
        self.sums = {int(n): float(total) for n, total in pairs.reshape(-1, 2)}


class LearnsAtOnce(Learns):
    def ask_after(self, number, batches):
        return super().ask_after(number, max(self.sums))


class ForgetsLosses(Learns):
    def restore(self, batches, state):
        super().restore(batches, state)
        self.sums = dict.fromkeys(self.sums, 0.0)


class RestoresAnything(Learns):
    def restore(self, batches, state):
        with contextlib.suppress(ValueError):
            super().restore(batches, state)


class Ring(Buffer):
    """Keeps the last rows, and draws from all."""

    def __init__(self, capacity=32):
        self.capacity = capacity

    def needed(self, batch):
        return self.capacity + 4 * batch

    def place(self, count, random):
        return np.arange(self.arrived, self.arrived + count) % self.capacity

    def draw(self, random):
        return random.integers(0, self.capacity, self.batch_size)


class Decreases(Ring):
    def needed(self, batch):
        return self.capacity + 4 * (batch % 7)


class NeedsByState(Ring):
    def needed(self, batch):
        return super().needed(batch) + int(self.arrived > 60)


class Impatient(Ring):
    def needed(self, batch):
        return 8 + 4 * batch


class OwnRandom(Ring):
    def draw(self, random):
        return np.random.default_rng().integers(0, self.capacity, self.batch_size)


class HiddenState(Ring):
    def begin(self, batch_size, batch_nb, seed):
        super().begin(batch_size, batch_nb, seed)
        self.drawn = 0

    def draw(self, random):
        self.drawn += 1
        return (super().draw(random) + self.drawn) % self.capacity


class NoStepBack(Ring):
    def state(self, batches):
        return super().state(self._taken)


class TakesAnyState(Ring):
    def restore(self, batches, state):
        with contextlib.suppress(ValueError):
            super().restore(batches, state)
