"""Streams that remember all that happened, to be interrupted and resumed."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np

from physx_core import Environment, Field, Parameter
from physx_core.errors import UsageError


class River(Environment):
    """Each row depends on all before it, on what was saved, on parameters, and on answers."""

    made = 0  # steps of all instances in this process

    def __init__(self, *, parameters=False, asks=False, refuse=0, delay=0.0, kind="", **kwargs):
        super().__init__(**kwargs)
        self.has_parameters, self.asks, self.refuse = parameters, asks, refuse
        self.delay, self.kind, self.load = delay, kind, 0.0

    def create(self):
        if self.has_parameters:
            self.define_parameters(Parameter("load", 0.0, 1.0))
        self.position = np.zeros(2)
        self.runs = self.load_parameters().get("runs", 0)
        self.save_parameters(runs=self.runs + 1)
        self.answer = self.ask(np.ones(2))
        if self.kind == "opaque":
            self.lock = threading.Lock()

    def init_database(self):
        self.define_training_fields([Field("x", (2,)), Field("y", (1,))])

    def reset_parameters(self, load=0.0):
        self.load = load

    def step(self):
        type(self).made += 1
        time.sleep(self.delay)
        if self.has_parameters and self.step_index % 7 == 6:
            self.new_episode()
        for _ in range((self.step_index + self.instance_id) % 3):
            self.answer = self.ask(self.position + np.tanh(self.answer))
        noise = self.rng.normal(size=2) + self.load + self.runs
        if self.step_index % 4 == 0:
            self.save_parameters(last=self.step_index)
        noise += 0.01 * self.load_parameters().get("last", 0)
        self.position = 0.9 * self.position + noise + 0.1 * np.tanh(self.answer)
        y = np.tanh(self.position.sum(keepdims=True) + self.answer)
        self.set_training_data(x=self.position, y=y)

    def ask(self, x):
        if self.asks:
            try:
                return self.get_prediction(x=x)["y"]
            except UsageError:  # before the first batch there are no fields
                Path("refused").touch()
        return np.zeros(1)

    def check_sample(self):
        return not self.refuse or self.step_index % self.refuse != 2
