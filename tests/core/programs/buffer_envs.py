"""An environment of trainings with buffers, that clients import from this file."""

import os
import random
import time

import numpy as np

from physx_core import Environment, Field


class Drawn(Environment):
    """Random states; in clients that are asked to, steps take random times."""

    def __init__(self, *, delay=0.0, fails_at=None, **kwargs):
        super().__init__(**kwargs)
        self.delay, self.fails_at = delay, fails_at

    def create(self):
        self.count = 0

    def init_database(self):
        self.define_training_fields([Field("x", shape=(3,), unit="m"), Field("y", shape=(2,))])
        self.define_additional_fields(
            [Field("number", shape=(), dtype="int64"), Field("grid", shape=(20, 20))]
        )

    def step(self):
        if self.count == self.fails_at:
            raise RuntimeError("enough")
        if self.delay:
            time.sleep(random.Random(os.urandom(4)).random() * self.delay)
        x = self.rng.normal(size=3)
        self.set_training_data(x=x, y=np.array([x[0] - x[1], 2 * x[2]]))
        self.set_additional_data(number=self.count, grid=np.tile(np.arange(20), (20, 1)) + x[1])
        self.count += 1
