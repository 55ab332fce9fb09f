"""Rods of any number of nodes that are pulled, as an environment with free axes."""

import numpy as np

from physx_core import Environment, Field


class Rods(Environment):
    """Each step is another rod: its nodes, edges, a load, and the displacement of the nodes."""

    independent_episodes = True
    episode_steps = 2
    asks = False

    def create(self):
        """Nothing is simulated."""

    def init_database(self):
        self.define_training_fields(
            [
                Field("x", ("node", 1), unit="m"),
                Field("edge", ("edge", 2), "int64", indexes="node"),
                Field("load", (), unit="N"),
                Field("u", ("node",), unit="m"),
            ]
        )
        if self.independent_episodes:
            self.define_episode_fields(Field("geometry", ("corner", 2)))

    def reset_parameters(self):
        if self.independent_episodes:
            self.set_episode_data(geometry=self.rng.random((int(self.rng.integers(1, 5)), 2)))

    def step(self):
        count = int(self.rng.integers(2, 9))
        x, load = np.sort(self.rng.random((count, 1)), axis=0), self.rng.normal()
        edge = np.stack([np.arange(count - 1), np.arange(1, count)], 1)
        self.set_training_data(x=x, edge=edge, load=load, u=load * x[:, 0])
        if self.asks:
            found = self.get_prediction(x=x, edge=edge, load=load)
            assert found["u"].shape == (count,)


class AskingRods(Rods):
    """A stream that asks the network about each rod."""

    independent_episodes = False
    episode_steps = None
    asks = True
