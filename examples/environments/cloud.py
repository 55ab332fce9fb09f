"""A cloud of points and its spread: the root mean square of the points along its principal axes.

A singular value decomposition computes the spread exactly, so a network's predictions are easy to
check. It is not a linear function of the points: the best linear map does no better than the mean
of all clouds.
"""

from __future__ import annotations

import time

import numpy as np

from physx_core import Environment, Field, NetworkConfig

POINTS = 10


class Cloud(Environment):
    """Each step draws a cloud, unless it is constant; a network has to predict its spread."""

    def __init__(self, *, constant: bool = False, delay: float = 0.0, **kwargs) -> None:
        super().__init__(**kwargs)
        self.constant, self.delay = constant, delay

    def create(self) -> None:
        self.draw()

    def draw(self) -> None:
        """Draw a cloud with a random orientation, more or less elongated or flat."""
        directions = np.linalg.qr(self.rng.normal(size=(3, 3)))[0]
        around = self.rng.normal(size=(POINTS, 3)) * self.rng.uniform(0.1, 1, 3)
        self.points = around @ directions
        self.middle = self.points.mean(axis=0)
        _, values, self.axes = np.linalg.svd(self.points - self.middle)
        self.spread = values / np.sqrt(POINTS)

    def init_database(self) -> None:
        self.define_training_fields(
            [Field("input", (POINTS, 3), unit="m"), Field("ground_truth", (3,), unit="m")]
        )

    def step(self) -> None:
        time.sleep(self.delay)  # as if there were more to simulate
        if not self.constant:
            self.draw()
        self.set_training_data(input=self.points, ground_truth=self.spread)

    def lines(self, spread: np.ndarray) -> np.ndarray:
        """Return lines along the principal axes, shape (3, 2, 3): their ends in m."""
        ways = spread[:, None] * self.axes
        return np.stack([self.middle - ways, self.middle + ways], axis=1)

    def init_visualization(self) -> None:
        lines = list(self.lines(self.spread))
        self.factory.set_view("a cloud", eye=(3, -3, 2), target=(0, 0, 0))
        self.factory.add_points("cloud", self.points, size=0.1)
        self.factory.add_lines("spread", lines, size=0.03, color="green")
        self.factory.add_lines("guess", lines, size=0.06, color="orange")

    def apply_prediction(self, prediction) -> None:
        self.factory.update_points("cloud", positions=self.points)
        self.factory.update_lines("spread", positions=list(self.lines(self.spread)))
        guess = self.lines(prediction["prediction"])
        self.factory.update_lines("guess", positions=list(guess))


class IndependentCloud(Cloud):
    """Each cloud is an episode of its own, which depends on none before it."""

    independent_episodes, episode_steps = True, 1


def network(width: int = 128) -> NetworkConfig:
    """Return fully connected layers that predict the spread from the coordinates of all points."""
    return NetworkConfig(
        "torch/fc",
        network_kwargs={"layers": [3 * POINTS, width, width, 3]},
        loss="MSELoss",
        optimizer="Adam",
        lr=2e-3,
    )
