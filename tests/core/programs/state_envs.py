"""Streams whose clients are killed at chosen places, and that feel that a state is taken."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

from physx_core import Environment, Field, Parameter


def current():
    """Return the simulation that this is in; None: this is in the test itself, or in a process."""
    module = sys.modules.get("simulated")
    return None if module is None else module.Simulation.current


class Engine:
    """An engine that forgets what its solver starts from when it gives a snapshot."""

    def __init__(self):
        self.position, self.warm = 0.0, 0.0

    def advance(self, force):
        self.warm = 0.5 * self.warm + 1e-9 * force
        self.position += force + self.warm

    def snapshot(self):
        self.warm = 0.0
        return {"position": self.position}

    def restore(self, snapshot):
        self.position, self.warm = snapshot["position"], 0.0


class Stream(Environment):
    """A stream that asks, obeys, rejects, draws and replays; its client is killed once per place.

    A place is what happens and the row: "step 3", "prediction 3", "apply 3", or "create".
    """

    def __init__(self, *, kills=(), asks=True, refuse=4, pace=0.0, parameters=False, **kwargs):
        super().__init__(**kwargs)
        self.kills, self.asks, self.refuse = list(kills), asks, refuse
        self.pace, self.parameters = pace, parameters
        self.pull, self.load = 0.0, 0.0

    def create(self):
        if self.parameters:
            self.define_parameters(Parameter("load", 0.0, 1.0))
        self.engine = Engine()
        self.first = self.load_parameters().get("first", self.instance_id)
        self.save_parameters(first=self.first + 1)
        self.reach("create")

    def init_database(self):
        self.define_training_fields([("position", np.ndarray), Field("predicted", ())])

    def init_visualization(self):
        self.factory.add_points("body", np.zeros((1, 3)), color="red")

    def reset_parameters(self, load=0.0):
        self.load = load

    def step(self):
        self.reach(f"step {self.step_index}")
        if self.parameters and self.step_index % 5 == 4:
            self.new_episode()
        if simulation := current():
            simulation.steps = getattr(simulation, "steps", 0) + 1
            simulation.sleep(self.pace)
        given = 0.0 if self.sample is None else float(self.sample["position"][0])
        self.engine.advance(self.rng.normal() + self.pull + self.load + given)
        predicted = 0.0
        for _ in range(self.step_index % 3 if self.asks else 0):
            answer = self.get_prediction(x=np.array([self.engine.position + predicted]))
            predicted = float(answer["y"][0])
        self.reach(f"prediction {self.step_index}")
        if self.factory:
            position = np.array([[self.engine.position, 0.0, 0.0]])
            self.factory.update_points("body", positions=position)
        position = np.array([self.engine.position, self.first])
        self.set_training_data(position=position, predicted=predicted)

    def check_sample(self):
        return not self.refuse or self.step_index % self.refuse != 2

    def apply_prediction(self, prediction):
        self.pull = 1e-3 * float(prediction["y"][0])
        self.reach(f"apply {self.step_index}")

    def reach(self, place):
        note = Path(f"{place.replace(' ', '-')}-{self.instance_id}")
        if place in self.kills and not note.exists():
            note.touch()
            self.kill()

    def kill(self):
        current().running.kill()
        current().sleep(0)


class Opaque(Stream):
    """A stream whose state cannot be captured."""

    def create(self):
        super().create()
        self.lock = threading.Lock()


class LaterOpaque(Stream):
    """A stream whose state cannot be captured from some row on."""

    def step(self):
        if self.step_index == 11:
            self.lock = threading.Lock()
        super().step()


class Changing(Stream):
    """A stream that each process creates differently."""

    def create(self):
        super().create()
        self.marker = getattr(current(), "events", 0)


class Mortal(Environment):
    """A stream whose processes do not get further than some rows each."""

    made = 0  # by this process

    def __init__(self, *, life=0, **kwargs):
        super().__init__(**kwargs)
        self.life, self.position = life, np.zeros(3)

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields(Field("position", (3,)))

    def step(self):
        if self.life and Mortal.made == self.life:
            os.kill(os.getpid(), signal.SIGKILL)
        Mortal.made += 1
        self.position = self.position + self.rng.normal(size=3)
        self.set_training_data(position=self.position)


class Voyage(Environment):
    """Long independent episodes, at whose steps a client is killed or a run is interrupted."""

    independent_episodes = True
    made = stop = 0  # steps of this process; at which one it is interrupted, 0: none

    def __init__(self, *, kills=(), pace=0.0, wait=0.0, life=0, rows=60, refuse=0, **kwargs):
        super().__init__(**kwargs)
        self.kills, self.pace, self.wait = list(kills), pace, wait
        self.life, self.rows, self.refuse = life, rows, refuse

    def create(self):
        self.engine = Engine()

    def init_database(self):
        self.define_training_fields(Field("x", (2,)))

    def reset_parameters(self):
        self.engine.position, self.engine.warm = 0.0, 0.0
        self.seen = []

    def step(self):
        self.live()
        self.engine.advance(self.rng.normal())
        self.seen = [*self.seen[-3:], self.engine.position]
        self.set_training_data(x=[self.engine.position, sum(self.seen)])
        if self.step_index == self.rows - 1:
            self.end_episode()

    def check_sample(self):
        return not self.refuse or self.step_index % self.refuse > 0

    def live(self):
        if simulation := current():
            simulation.steps = getattr(simulation, "steps", 0) + 1
            simulation.sleep(self.pace)
            killed, place = vars(simulation).setdefault("killed", set()), self.step_index
            if place in self.kills and (self.episode_index, place) not in killed:
                killed.add((self.episode_index, place))
                simulation.running.kill()
                simulation.sleep(0)
        time.sleep(self.wait)
        Voyage.made += 1
        if self.life and Voyage.made > self.life:
            os.kill(os.getpid(), signal.SIGKILL)
        if Voyage.made == Voyage.stop:
            raise KeyboardInterrupt


class OpaqueVoyage(Voyage):
    """Its state cannot be captured."""

    def create(self):
        super().create()
        self.lock = threading.Lock()


class OwnVoyage(Voyage):
    """Its state is refused by whoever did not give it."""

    def create(self):
        super().create()
        self.mark = object.__hash__(self)
