"""Environments of which each has one mistake, and one that has none."""

import os
import signal
import subprocess
import tempfile
import threading
import time

import numpy as np

from physx_core import Environment, Field


class Right(Environment):
    def create(self):
        self.state = self.rng.standard_normal(2)

    def init_database(self):
        self.define_training_fields([Field("state", (2,)), Field("count", (), "int64")])

    def step(self):
        self.state = self.state + 0.1 * self.rng.standard_normal(2)
        self.set_training_data(state=self.state, count=self.step_index)


class GlobalRandom(Right):
    def step(self):
        self.state = self.state + np.random.rand(2)  # noqa: NPY002
        self.set_training_data(state=self.state, count=self.step_index)


class Unseeded(Right):
    def create(self):
        self.state = np.random.default_rng().standard_normal(2)


class Shared(Right):
    total = np.zeros(2)

    def step(self):
        Shared.total = Shared.total + self.rng.standard_normal(2)
        self.set_training_data(state=Shared.total, count=self.step_index)

    def close(self):
        Shared.total = np.zeros(2)


class NotFinite(Right):
    def step(self):
        super().step()
        if self.step_index == 3:
            self.set_training_data(state=np.array([np.nan, 0]), count=3)


class OtherShape(Right):
    def step(self):
        super().step()
        if self.step_index == 2:
            self.set_training_data(state=np.zeros(3), count=2)


class MissingField(Right):
    def step(self):
        self.set_training_data(state=self.state)


class Swallows(Right):
    def __init__(self, *, instance_id=1, instance_nb=1, seed=None, **kwargs):
        super().__init__(instance_id=instance_id, instance_nb=instance_nb, seed=seed)


class FirstForEver(Right):
    def __init__(self, *, instance_id=1, instance_nb=1, seed=None):
        super().__init__(instance_id=1, instance_nb=1, seed=seed)


class Meddles(Right):
    def create(self):
        super().create()
        os.chdir("/")
        os.umask(0o027)
        tempfile.tempdir = f"/tmp/{time.monotonic()}"
        os.environ.update(MEDDLED=str(time.monotonic()))
        signal.signal(signal.SIGUSR1, lambda *_: None)
        self.process = subprocess.Popen(["sleep", "100"])


class DrawsRandomly(Right):
    def init_visualization(self):
        self.factory.add_sphere("ball", 0.1, position=[*self.rng.random(2), 0])

    def step(self):
        super().step()
        self.update_visualization()


class ClosesOnce(Right):
    def close(self):
        del self.state


class Crashes(Right):
    def step(self):
        super().step()
        if self.step_index == 4:
            os.kill(os.getpid(), signal.SIGSEGV)


class Hangs(Right):
    def step(self):
        if self.factory:
            time.sleep(1000)
        super().step()


class ReplaysAnything(Right):
    def step(self):
        if self.sample is not None:
            self.state = self.sample["state"] + np.random.default_rng().random(2)
        super().step()


class OtherInClients(Right):
    def step(self):
        super().step()
        if "PHYSX_CLIENT" in os.environ:
            self.set_training_data(state=self.state + 1, count=self.step_index)


class Constant(Right):
    def create(self):
        self.rng = np.random.default_rng(0)
        super().create()


class Asks(Right):
    def step(self):
        super().step()
        self.state = self.state + self.get_prediction()["state"]


class Forgets(Right):
    """Keeps something where states do not look."""

    constants = ("memory",)

    def create(self):
        super().create()
        self.memory = [0]

    def step(self):
        self.memory.append(1)
        self.state = self.state + len(self.memory)
        self.set_training_data(state=self.state, count=self.step_index)


class CreatesRandomly(Right):
    def create(self):
        super().create()
        self.drift = os.getpid()


class Holds(Right):
    def create(self):
        super().create()
        self.lock = threading.Lock()


class Engine:
    def __init__(self):
        self.value = self.warmth = 0.0

    def step(self):
        self.warmth += 1.0
        self.value += 1e-3 * self.warmth

    def snapshot(self):
        self.warmth = 0.0
        return self.value

    def restore(self, state):
        self.value, self.warmth = state, 0.0


class Disturbed(Right):
    def create(self):
        super().create()
        self.engine = Engine()

    def step(self):
        self.engine.step()
        self.set_training_data(state=self.state + self.engine.value, count=self.step_index)
