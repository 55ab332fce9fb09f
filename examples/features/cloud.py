"""The environment of these scripts: a random cloud of points, and its mean."""

from __future__ import annotations

import time

import numpy as np

from physx_core import Environment, Field, NetworkConfig

POINTS = 10


class Cloud(Environment):
    """Each step draws a cloud, unless it is to stay the same; the network shall guess the mean."""

    def __init__(self, *, constant: bool = False, delay: float = 0.0, **kwargs) -> None:
        super().__init__(**kwargs)
        self.constant, self.delay = constant, delay

    def create(self) -> None:
        self.draw()

    def draw(self) -> None:
        self.points = self.rng.uniform(-1, 1, 3) + self.rng.uniform(-1, 1, (POINTS, 3))
        self.mean = self.points.mean(axis=0)

    def init_database(self) -> None:
        self.define_training_fields(
            [Field("input", (POINTS, 3), unit="m"), Field("ground_truth", (3,), unit="m")]
        )

    def init_visualization(self) -> None:
        self.factory.add_points("cloud", self.points, size=0.1)
        self.factory.add_points("mean", [self.mean], size=0.15, color="green")
        self.factory.add_points("guess", [self.mean], size=0.15, color="orange", alpha=0.5)

    def step(self) -> None:
        time.sleep(self.delay)  # as if there were more to simulate
        if not self.constant:
            self.draw()
        self.set_training_data(input=self.points, ground_truth=self.mean)

    def apply_prediction(self, prediction) -> None:
        self.factory.update_points("cloud", positions=self.points)
        self.factory.update_points("mean", positions=[self.mean])
        self.factory.update_points("guess", positions=[prediction["prediction"]])
        self.update_visualization()

    @staticmethod
    def distance(guess: np.ndarray, mean: np.ndarray) -> float:
        """Return the mean distance of guesses from the means, in m."""
        return float(np.linalg.norm(guess - mean, axis=-1).mean())


NETWORK = NetworkConfig(
    "torch/fc",
    network_kwargs={"layers": [3 * POINTS, 3 * POINTS, 3 * POINTS, 3]},
    loss="MSELoss",
    optimizer="Adam",
    lr=1e-3,
)
