"""Environments with parameters."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path

import numpy as np

from physx_core import Environment, Field, Parameter


class Swing(Environment):
    """Episodes of a few steps with two parameters; its rows show all that an episode depends on."""

    def __init__(self, *, length=3, fails_above=1e9, how="raise", folder=".", **kwargs):
        super().__init__(**kwargs)
        self.length, self.fails_above, self.how = length, fails_above, how
        self.pauses = random.Random(self.instance_id)
        self.died = Path(folder) / f"died_{self.instance_id}"

    def create(self):
        self.define_parameters(
            [
                Parameter("stiffness", 10.0, 40.0, unit="N/m"),
                Parameter("push", [-1.0, 0.0], [1.0, 2.0], shape=(2,)),
            ]
        )

    def init_database(self):
        self.define_training_fields([Field("x", (3,)), Field("noise", ())])

    def reset_parameters(self, stiffness, push):
        self.stiffness, self.push, self.made = stiffness, push, 0
        if self.how == "reset" and stiffness > self.fails_above:
            raise ValueError("this does not hold")

    def step(self):
        is_stuck = self.how == "wrong" and self.stiffness > self.fails_above and self.made == 2
        if self.made == self.length:
            self.new_episode()
        noise = self.rng.random()
        self.made += not is_stuck
        if self.stiffness > self.fails_above and self.made == 2:
            if self.how == "raise":
                raise ValueError("it broke")
            if self.how == "nan":
                noise = np.nan
            if self.how == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
        if self.how == "slow":
            time.sleep(self.pauses.random() ** 4 * 0.05)
        if self.how == "once" and self.step_index == 5 and not self.died.exists():
            self.died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        self.set_training_data(x=[self.stiffness, *self.push], noise=noise)

    def check_sample(self):
        return self.how != "wrong" or self.stiffness <= self.fails_above or self.made == 1


class Hard(Environment):
    """A function of two parameters that is flat but for a narrow peak, which is hard to learn."""

    def __init__(self, *, pause=0.0, **kwargs):
        super().__init__(**kwargs)
        self.pause = pause

    def create(self):
        self.define_parameters([Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0)])

    def init_database(self):
        self.define_training_fields([Field("x", (2,)), Field("y", (1,))])

    def reset_parameters(self, a, b):
        self.at = np.array([a, b])

    def step(self):
        if self.step_index:
            self.new_episode()
        time.sleep(self.pause)
        peak = 10 * np.exp(-np.sum((self.at - 0.8) ** 2) / 0.1**2)
        self.set_training_data(x=self.at, y=[peak])


class Again(Swing):
    """Adds to the stored rows what shows with which parameters they are replayed."""

    def step(self):
        stored, given = self.sample, [self.stiffness, *self.push]
        if stored is not None:
            if stored["x"].tolist() != given:
                raise ValueError(f"replayed with {given}, made with {stored['x']}")
            self.set_training_data(x=stored["x"], noise=stored["noise"] + 1)
        else:
            super().step()


class Plain(Environment):
    """Has no parameters."""

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields(Field("x", ()))

    def step(self):
        self.set_training_data(x=1.0)
