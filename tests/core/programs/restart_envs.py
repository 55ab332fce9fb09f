"""An environment whose clients break once, in one way and at one place, and are started again."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np

from physx_core import Environment, Field
from physx_core.errors import SampleError


class Wanderer(Environment):
    """A random walk that may ask the network, obey predictions, draw, replay, and break.

    All delays are true chance, in no way decided by the seed.
    """

    def __init__(
        self,
        *,
        asks: bool = False,
        delay: float = 0.0,
        pace: float = 0.0,
        refuse: int = 0,
        fault: str = "",
        place: str = "step",
        at: int = 5,
        who: int = 2,
        times: int = 1,
        **kwargs,
    ):
        super().__init__(**kwargs)
        self.asks, self.delay, self.pace, self.refuse = asks, delay, pace, refuse
        self.fault, self.place, self.at, self.who, self.times = fault, place, at, who, times
        self.position, self.pull = np.zeros(2), 0.0

    def create(self):
        Path(f"started-{self.instance_id}-{uuid.uuid4()}").touch()
        self.start_child()
        self.drawn = self.load_parameters().get("drawn", 0)
        self.save_parameters(drawn=self.drawn + 1)
        self.reach("create")

    def init_database(self):
        self.define_training_fields([("position", np.ndarray), Field("predicted", shape=(2,))])
        self.reach("init_database")

    def init_visualization(self):
        self.factory.add_points("walker", np.zeros((1, 3)), color="red")

    def start_child(self):
        self.child = subprocess.Popen(["sleep", "600"]) if self.fault else None

    def step(self):
        self.sleep(self.pace + self.delay * int.from_bytes(os.urandom(2), "little") / 65536)
        if self.step_index == self.at:
            self.reach("step")
        start = 0.0 if self.sample is None else self.sample["position"]
        self.position = self.position + start + self.rng.normal(size=2) + self.pull
        predicted = np.zeros(2)
        if self.asks:
            for _ in range(1 + self.step_index % 3):
                predicted = self.get_prediction(x=self.position + predicted)["y"]
            if self.step_index == self.at:
                self.reach("prediction")
        if self.factory:
            x, y = self.position
            self.factory.update_points("walker", positions=np.array([[x, y, 0.0]]))
            self.update_visualization()
        self.set_training_data(position=self.position, predicted=predicted)

    def check_sample(self):
        return not self.refuse or self.step_index % self.refuse != 0

    def apply_prediction(self, prediction):
        self.pull = float(prediction["y"][0])
        if self.step_index > self.at:
            self.reach("apply_prediction")

    def close(self):
        self.reach("close")

    def reach(self, place):
        if place != self.place or self.instance_id != self.who or not self.fault:
            return
        broken = len(list(Path().glob("broke-*")))
        if broken < self.times:
            Path(f"broke-{broken}").touch()
            getattr(self, self.fault)()

    # Ways to break --------------------------------------------------------------------------

    sleep = staticmethod(time.sleep)

    def dawdle(self):
        self.sleep(0.5)

    def fail(self):
        raise RuntimeError("no more beans")

    def refuse_rows(self):
        raise SampleError("this would come again")

    def leave(self):
        os._exit(3)

    def kill(self):
        os.kill(os.getpid(), signal.SIGKILL)

    def stop(self):
        os.kill(os.getpid(), signal.SIGSTOP)

    def garble(self):
        self.connection().sendall(b"\xff" * 100)
        self.sleep(60)

    def disconnect(self):
        self.connection().shutdown(socket.SHUT_RDWR)
        self.sleep(60)

    def connection(self):
        return connection()


class SimulatedWanderer(Wanderer):
    """The same in a simulated client, which breaks in the same ways."""

    def start_child(self):
        """Start none."""

    def sleep(self, seconds):
        simulation().sleep(seconds)

    def connection(self):
        return simulation().running.link._connection

    def leave(self):
        self.end(lambda client: client.leave(3))

    def kill(self):
        self.end(lambda client: client.kill())

    def stop(self):
        self.end(lambda client: client.stop())

    def end(self, how):
        how(simulation().running)
        self.sleep(0)


def simulation():
    return sys.modules["simulated"].Simulation.current


def connection():
    """The client's connection to its server, found among the open files of the process."""
    for entry in Path("/proc/self/fd").iterdir():
        try:
            found = socket.socket(fileno=os.dup(int(entry.name)))
            found.getpeername()
        except OSError:
            continue
        return found
    raise RuntimeError("there is no connection")
