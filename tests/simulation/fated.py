"""An environment in simulated clients that end, hang or are cut off in a given state."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from simulated import SimulatedLauncher, Simulation

from physx_core import Environment


@dataclass
class Fate:
    """What happens to a client, once.

    Attributes:
        state: Its state then.
        event: What happens.
        after: After how many of the client's rows it happens if it is busy, or of the run's batches
            if it is idle.
        began: Simulated time in s at which it happened; None: it has not.
    """

    state: str
    event: str
    after: int = 0
    began: float | None = None

    def strike(self, client):
        """Let it happen."""
        self.began = client.clock.monotonic()
        if self.event == "exits":
            client.leave(3)
        elif self.event == "fails":
            raise RuntimeError("no more beans")
        elif self.event == "is killed":
            client.kill()
        elif self.event == "hangs":
            client.stop()
        else:
            client.vanish()


class Fates:
    """The fates of all clients, which those of an instance meet one after another.

    Attributes:
        coming: Instance to the fates of its clients, the next one first.
        launches: Instance to the simulated times in s at which its clients were started.
    """

    def __init__(self, fates, count):
        self.coming = {number: deque(fates.get(number, ())) for number in range(1, count + 1)}
        self.launches = {number: [] for number in self.coming}
        self._met = []

    def strike(self, client, state, count=math.inf):
        """Let a client meet its fate, if that is due and it has met none."""
        coming = self.coming[client.instance_id]
        is_due = coming and coming[0].state == state and count >= coming[0].after
        if is_due and client not in self._met:
            self._met.append(client)
            coming.popleft().strike(client)


class FatedLauncher(SimulatedLauncher):
    """Starts clients in the current simulation, some of which get no further."""

    def launch(self, instances, address, token):
        started, fates = super().launch(instances, address, token), Simulation.current.fates
        for client in started:
            fates.launches[client.instance_id].append(client.clock.monotonic())
            fates.strike(client, "starting")
        return started


class Fated(Environment):
    """A random walk of steps that take some time in s."""

    def __init__(self, *, pace=0.01, **kwargs):
        super().__init__(**kwargs)
        self.pace = pace

    def create(self):
        self.position = np.zeros(2)
        self.reach("joining")

    def init_database(self):
        self.define_training_fields(("position", np.ndarray))

    def step(self):
        if simulation := Simulation.current:
            simulation.sleep(self.pace)
        self.reach("busy", self.step_index)
        self.position = self.position + self.rng.normal(size=2)
        self.set_training_data(position=self.position)

    def close(self):
        self.reach("closing")

    def reach(self, state, count=math.inf):
        if simulation := Simulation.current:
            simulation.fates.strike(simulation.running, state, count)
            simulation.sleep(0)  # where it ends
