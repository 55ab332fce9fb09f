"""The environments of transport.py, in a separate file that clients import quickly."""

from __future__ import annotations

import math
import os
import time
from typing import Any

import numpy as np

from physx_core import Environment, Field, Parameter


class Rows(Environment):
    """Sets the same two arrays in each step: the fastest possible samples."""

    def __init__(self, *, values: int, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.x, self.y = np.zeros(values - values // 6), np.zeros(values // 6)

    def create(self) -> None:
        """Nothing is simulated."""

    def init_database(self) -> None:
        """Define two fields."""
        self.define_training_fields([Field("x", self.x.shape), Field("y", self.y.shape)])

    def step(self) -> None:
        """Set the arrays."""
        self.set_training_data(x=self.x, y=self.y)


class Episodes(Rows):
    """The same in independent episodes with a parameter."""

    episode_steps = 10

    def create(self) -> None:
        """Define the parameter."""
        self.define_parameters(Parameter("mass", 1, 2))

    def reset_parameters(self, mass: float) -> None:
        """Set the parameter."""
        self.x[0] = mass


class Asking(Rows):
    """Asks for many predictions in each step, on its own processor core if it gets one."""

    def __init__(self, *, asks: int, core: int | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.asks = asks
        if core is not None:
            os.sched_setaffinity(0, {core})

    def step(self) -> None:
        """Ask, and then set the arrays."""
        for _ in range(self.asks):
            self.get_prediction(x=self.x, y=self.y)
        super().step()


class Working(Rows):
    """Computes for a while in each step, and now and then for as long as many steps take.

    The arrays start with the times, in s, when a step began to compute and when it ended.
    """

    def __init__(self, *, work: int, block: int, **kwargs: Any) -> None:
        super().__init__(values=6, **kwargs)
        self.work, self.block, self.steps = work, block, 0

    def step(self) -> None:
        """Compute; in the first step and after every `block` further ones, for `block` steps."""
        count = 1 if self.steps % (self.block + 1) else self.block
        self.steps += 1
        self.x[0] = time.perf_counter()
        for _ in range(count):
            compute(self.work)
        self.y[0] = time.perf_counter()
        super().step()


class Sleeping(Rows):
    """Sleeps in each step."""

    def __init__(self, *, seconds: float, **kwargs: Any) -> None:
        super().__init__(values=6, **kwargs)
        self.seconds = seconds

    def step(self) -> None:
        """Sleep, and then set the arrays."""
        time.sleep(self.seconds)
        super().step()


def compute(work: int) -> float:
    """Do some units of work that need nothing but the processor."""
    value = 0.5
    for _ in range(work):
        value = math.cos(value)
    return value
