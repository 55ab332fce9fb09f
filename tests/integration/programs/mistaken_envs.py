"""Environments with one mistake each, for `test_beginners_mistakes`."""

from __future__ import annotations

import os
import time

import numpy as np

from physx_core import Environment, Field


class Good(Environment):
    """A point that moves at random; nothing is wrong with it."""

    def create(self):
        self.x = np.zeros(2)

    def init_database(self):
        self.define_training_fields([("state", np.ndarray), ("next_state", np.ndarray)])

    def step(self):
        before, self.x = self.x, self.x + self.rng.standard_normal(2)
        self.set_training_data(state=before, next_state=self.x)


class Sized(Good):
    """Good, and its fields have shapes."""

    def init_database(self):
        self.define_training_fields([Field("state", (2,)), Field("next_state", (2,))])


class Raises(Good):
    def step(self):
        if self.step_index == 3:
            raise ZeroDivisionError("the solver diverged")
        super().step()


class Exits(Good):
    def step(self):
        if self.step_index == 3:
            os._exit(7)
        super().step()


class Hangs(Good):
    def step(self):
        if self.step_index == 3:
            time.sleep(600)
        super().step()


class AsksWithAnotherShape(Sized):
    def step(self):
        super().step()
        self.get_prediction(state=np.zeros(3))


class AsksWithNan(Sized):
    def step(self):
        super().step()
        self.get_prediction(state=np.array([0.0, np.nan]))


class OldConstructor(Good):
    def __init__(self, as_tcp_ip_client=True, instance_id=1, instance_nb=1):
        super().__init__(instance_id=instance_id, instance_nb=instance_nb)


class ForgetsSuper(Good):
    def __init__(self, **kwargs):
        self.color = "red"


class IgnoresSample(Good):
    """Makes new samples whatever it is to replay."""


class AsksBeforeShapesAreKnown(Good):
    """As DeepPhysX's online examples: arrays without shapes, a prediction within each step."""

    def step(self):
        super().step()
        assert self.get_prediction(state=self._training["state"])["prediction"].shape == (2,)


class Point:
    """Is no environment, though it has an environment's methods."""

    def create(self):
        self.x = 0.0

    def step(self):
        self.x += 1.0
