"""An environment that takes its time by true chance, and may ask the network that learns."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from pathlib import Path

import numpy as np

from physx_core import Environment, Field, Parameter
from physx_core.errors import UsageError


class Pupil(Environment):
    """Draws x and y; keeps what the network answers for x, where it asks."""

    def __init__(
        self,
        *,
        delay: float = 0.0,
        asks: bool = False,
        refuse: int = 0,
        fails_at: int = -1,
        kill_at: int = -1,
        **kwargs,
    ):
        super().__init__(**kwargs)
        self.delay, self.asks, self.refuse = delay, asks, refuse
        self.fails_at, self.kill_at = fails_at, kill_at
        self.slope = 1.0

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([Field("x", (2,)), Field("y", (1,))])
        self.define_additional_fields(Field("answer", (1,)))

    def init_visualization(self):
        self.factory.add_points("x", np.zeros((1, 3)))

    def step(self):
        time.sleep(self.delay * int.from_bytes(os.urandom(2), "little") / 65536)
        step, last = self.step_index, self.instance_id == self.instance_nb
        if last and step == self.fails_at:
            raise RuntimeError("no more beans")
        if last and step == self.kill_at and not Path("killed").exists():
            Path("killed").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        x, answer = self.rng.random(2), np.zeros(1)
        for _ in range((step + self.instance_id) % 3 if self.asks else 0):
            with contextlib.suppress(UsageError):  # before the first batch there are no fields
                answer = self.get_prediction(x=x + 0.1 * answer)["y"]
        if self.factory:
            self.factory.update_points("x", positions=np.append(x, 0.0)[None])
            self.update_visualization()
        y = self.slope * x.sum(keepdims=True) + 0.1 * self.rng.normal(size=1) + 0.01 * answer
        self.set_training_data(x=x, y=y)
        self.set_additional_data(answer=answer)

    def check_sample(self):
        return not self.refuse or self.step_index % self.refuse != 1


class Apprentice(Pupil):
    """Has a parameter, and counts with what it saves how many runs it took part in."""

    def create(self):
        self.define_parameters([Parameter("slope", 0.5, 1.5)])
        self.runs = 1
        if not self.independent_episodes:  # their instances share what they save
            self.runs += self.load_parameters().get("runs", 0)
            self.save_parameters(runs=self.runs)

    def reset_parameters(self, slope):
        self.slope = slope * self.runs

    def step(self):
        if self.step_index % 4 == 3:
            self.new_episode()
        super().step()


class Lesson(Environment):
    """Independent episodes of different lengths, noted in a file when they begin and end."""

    independent_episodes = True

    def __init__(
        self, *, delay=0.0, fails=(), dies=(), asks=False, rejects=0.0, plain=False, **kwargs
    ):
        super().__init__(**kwargs)
        self.delay, self.fails, self.dies, self.asks = delay, fails, dies, asks
        self.rejects, self.is_plain = rejects, plain or asks

    def create(self):
        self.define_parameters([Parameter("slope", 0.5, 1.5)])

    def init_database(self):
        self.define_training_fields([Field("x", (2,)), Field("y", (1,))])
        if not self.is_plain:
            self.define_episode_fields(("number", int))

    def reset_parameters(self, slope):
        self.slope, self.left = slope, int(self.rng.integers(1, 6))
        if not self.is_plain:
            self.set_episode_data(number=self.episode_index)
        self.note("begun")

    def step(self):
        time.sleep(self.delay * int.from_bytes(os.urandom(2), "little") / 65536)
        if self.episode_index in self.fails:
            raise RuntimeError("no more beans")
        if self.episode_index in self.dies and not Path(f"died_{self.episode_index}").exists():
            Path(f"died_{self.episode_index}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        x = self.rng.random(2)
        if self.asks:
            self.get_prediction(x=x)
        self.set_training_data(x=x, y=self.slope * x.sum(keepdims=True))
        self.is_good = not self.rejects or self.rng.random() >= self.rejects
        self.left -= 1
        if not self.left:
            self.end_episode()
            self.note("ended")

    def check_sample(self):
        return self.is_good

    def note(self, what):
        with Path("simulated.txt").open("a") as file:
            file.write(f"{what} {self.episode_index}\n")
