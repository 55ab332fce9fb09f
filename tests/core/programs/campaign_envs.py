"""An environment of independent episodes, some of which have troubles of their own."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np

from physx_core import Environment, Parameter


class Troubled(Environment):
    """Normal numbers in a random number of rows; see `campaigns.rows_of` for what it computes.

    ``troubles`` has the number of an episode, as text, and what happens to it at which of its rows.
    Simulated clients meet their fates when they begin a row, see `fated`.
    """

    independent_episodes = True

    def __init__(
        self,
        *,
        troubles=None,
        least=0,
        most=4,
        width=2,
        pace=0.0,
        sleep=0.0,
        parameters=False,
        log="",
        long=0.0,
        once=False,
        **kwargs,
    ):
        super().__init__(**kwargs)
        self.troubles, self.least, self.most, self.width = troubles or {}, least, most, width
        self.pace, self.sleep, self.has_parameters, self.log = pace, sleep, parameters, log
        self.long, self.once = long, once
        self.stepped = 0

    def create(self):
        if self.has_parameters:
            self.define_parameters(Parameter("height", 1, 2))

    def init_database(self):
        self.define_training_fields([("x", np.ndarray), ("n", int)])
        if self.once:
            self.define_episode_fields(("number", int))

    def reset_parameters(self, height=0.0):
        number = self.episode_index
        if simulation := current():
            simulation.ready.append(simulation.running)
        self.kind, self.at = self.troubles.get(str(number), ("", 0))
        if self.once:
            self.set_episode_data(number=number)
        if self.log:
            with Path(self.log).open("a") as file:
                file.write(f"{number}\n")
        self.left = int(self.rng.integers(self.least, self.most + 1))
        if self.kind == "is long":
            self.left = self.at
        if self.kind == "raises early":
            raise RuntimeError(f"no beans for {number}")

    def step(self):
        if not self.left:
            self.end_episode()
            return
        self.spend()
        now = self.at == self.step_index
        if now and self.kind == "raises":
            raise RuntimeError(f"no more beans for {self.episode_index}")
        if now and self.kind == "ends the process":
            self.leave()
        if now and self.kind in ("hangs", "sleeps long"):
            time.sleep(100 if self.kind == "hangs" else self.long)
        if now and self.kind == "is busy long":
            until = time.monotonic() + self.long
            while time.monotonic() < until:
                pass
        if now and self.kind == "asks for the wrong":
            self.new_episode()
        self.left -= 1
        x = self.rng.normal(size=self.width)
        if now and self.kind == "is not finite":
            x[0] = np.nan
        sample = {"x": x, "n": self.step_index}
        if now and self.kind == "lacks a field":
            del sample["n"]
        self.set_training_data(**sample)

    def check_sample(self):
        is_due = self.step_index >= self.at and self.kind in ("raises late", "is rejected")
        if is_due and self.kind == "raises late":
            raise RuntimeError(f"late beans for {self.episode_index}")
        if is_due:
            self.left += 1
        return not is_due

    def spend(self):
        """Let time pass, in which a simulated client may meet its fate."""
        self.stepped += 1
        if self.sleep:
            time.sleep(self.sleep)
        simulation = current()
        if simulation is not None:
            simulation.sleep(self.pace)
            simulation.fates.strike(simulation.running, "busy", self.stepped)
            simulation.sleep(0)

    def leave(self):
        simulation = current()
        if simulation is None:
            os._exit(3)
        simulation.running.leave(3)
        simulation.sleep(0)


class Unchecked(Troubled):
    """One that accepts all samples."""

    check_sample = Environment.check_sample


def current():
    """Return the simulation that this client is in."""
    try:
        from simulated import Simulation
    except ImportError:
        return None
    return Simulation.current
