"""Environments for runs whose clients come and go."""

from __future__ import annotations

import time

import numpy as np

from physx_core import Environment


class Slow(Environment):
    """Instance 3 takes ten times as long as the others."""

    def create(self):
        self.pace = 0.03 if self.instance_id == 3 else 0.003

    def init_database(self):
        self.define_training_fields([("x", np.ndarray)])

    def step(self):
        time.sleep(self.pace)
        self.set_training_data(x=self.rng.normal(size=2))
