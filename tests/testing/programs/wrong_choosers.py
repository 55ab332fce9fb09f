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
    """Moves with the sum of the losses."""

    def begin(self, parameters, seed):
        super().begin(parameters, seed)
        self.sum = 0.0

    def tell(self, numbers, values, losses):
        self.sum += float(np.sum(losses))

    def ask(self, number):
        return self.values((self.random(number).random(self.size) + self.sum) % 1.0)

    def state(self):
        return np.array([self.sum])

    def restore(self, state):
        if np.shape(state) != (1,):
            raise ValueError("it is the state of another sampler")
        self.sum = float(state[0])


class LearnsByChance(Learns):
    def tell(self, numbers, values, losses):
        super().tell(numbers, values, losses * np.random.default_rng().random(len(losses)))


class ForgetsLosses(Learns):
    def restore(self, state):
        super().restore(0 * state)


class RestoresAnything(Learns):
    def restore(self, state):
        with contextlib.suppress(ValueError):
            super().restore(state)


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
