"""Environments whose episodes are independent."""

from __future__ import annotations

import numpy as np

from physx_core import Environment, Parameter


class Chapters(Environment):
    """A random walk of random length, which may be 0; see `chapter` for what it computes."""

    independent_episodes = True

    def __init__(self, *, ends="with the row", refuse=0, parameters=False, **kwargs):
        super().__init__(**kwargs)
        self.ends, self.refuse, self.has_parameters = ends, refuse, parameters

    def create(self):
        self.offset = self.rng.random()
        if self.has_parameters:
            self.define_parameters(Parameter("height", 1, 2))

    def init_database(self):
        self.define_training_fields(("x", np.ndarray))

    def init_visualization(self):
        self.factory.add_points("x", [[0, 0, 0]])

    def reset_parameters(self, height=0.0):
        self.left = int(self.rng.integers(self.ends == "with the row", 5))
        self.x = self.rng.normal() + height

    def step(self):
        if self.left == 0:
            self.end_episode()
            return
        self.left -= 1
        self.x += self.rng.normal()
        self.set_training_data(x=[self.x, self.offset, self.step_index])
        if self.factory:
            self.factory.update_points("x", positions=[[self.x, 0, 0]])
        if self.left == 0 and self.ends == "with the row":
            self.end_episode()

    def check_sample(self):
        return is_accepted(self.x, self.refuse)


def is_accepted(x, refuse):
    return not refuse or int(1000 * abs(x)) % refuse != 0


class Single(Environment):
    """Each step is a simulation of its own."""

    episode_steps = 1

    def create(self):
        self.define_parameters(Parameter("p", 0, 1))

    def init_database(self):
        self.define_training_fields([("x", float), ("p", float)])

    def reset_parameters(self, p):
        self.p = p

    def step(self):
        self.set_training_data(x=self.rng.random(), p=self.p)


class Mistaken(Environment):
    """Makes a mistake with its episodes."""

    def __init__(self, *, mistake, independent=True, **kwargs):
        super().__init__(**kwargs)
        self.mistake, self.independent_episodes = mistake, independent
        if mistake == "uses rng early":
            self.rng.random()

    def create(self):
        if self.mistake == "replaces rng":
            self.rng = np.random.default_rng(3)

    def init_database(self):
        self.define_training_fields(("x", float))

    def reset_parameters(self):
        pass

    def step(self):
        if self.mistake == "spawns":
            self.rng.spawn(1)
        if self.mistake == "begins the next":
            self.new_episode()
        if self.mistake == "ends":
            self.end_episode()
        if self.mistake == "is empty":
            self.end_episode()
            return
        self.set_training_data(x=1.0)


class Walk(Environment):
    """A stream, unless the configuration makes its episodes independent."""

    def __init__(self, *, sub_steps_end=False, **kwargs):
        super().__init__(**kwargs)
        self.sub_steps_end = sub_steps_end

    def create(self):
        self.x = 0.0

    def init_database(self):
        self.define_training_fields([("x", float), ("n", int)])

    def reset_parameters(self):
        self.x = 0.0

    def step(self):
        self.x += self.rng.normal() if self.sample is None else float(self.sample["x"])
        if self.sub_steps_end and not self.compute_training_data:
            self.end_episode()
        self.set_training_data(x=self.x, n=self.step_index)


class Blank(Environment):
    """A stream that has nothing which prepares an episode."""

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields(("x", float))

    def step(self):
        self.set_training_data(x=self.rng.random())
