"""Heat spreading in a plate from a hot spot: one simulation per set of parameters."""

from __future__ import annotations

import numpy as np

from physx_core import Environment, Field, Parameter

CELLS, FRAMES, DURATION = 24, 10, 0.02  # per edge of 1 m; per simulation; in s


class Heat(Environment):
    """The heat equation on the unit square with insulated edges, by explicit finite differences.

    An episode is a simulation of `FRAMES` samples: parameters and time, scaled to -1..1, and the
    temperature of all cells. All spots hold the same heat: narrow ones are hot and sharp, and stay
    so where heat spreads slowly. This small part of the parameter range is the hard one to learn.
    """

    PARAMETERS = (
        Parameter("x", 0.4, 0.6, unit="m"),
        Parameter("y", 0.4, 0.6, unit="m"),
        Parameter("width", 0.03, 0.4, unit="m"),
        Parameter("diffusivity", 0.05, 1.0, unit="m^2/s"),
    )

    episode_steps = FRAMES

    def create(self):
        """Define the parameters."""
        self.define_parameters(self.PARAMETERS)
        self._centers = (np.arange(CELLS) + 0.5) / CELLS

    def init_database(self):
        """Define the network's input and output."""
        self.define_training_fields(
            [Field("input", shape=(5,)), Field("temperature", shape=(CELLS, CELLS), unit="K")]
        )

    def reset_parameters(self, x, y, width, diffusivity):
        """Start with a hot spot."""
        across, along = self._centers[:, None] - x, self._centers[None, :] - y
        spot = np.exp(-(across**2 + along**2) / (2 * width**2))
        self._temperature = (0.1 / width) ** 2 * spot
        self._frame = 0
        low = np.array([each.low[0] for each in self.PARAMETERS])
        high = np.array([each.high[0] for each in self.PARAMETERS])
        given = np.array([x, y, width, diffusivity])
        self._scaled = 2 * (given - low) / (high - low) - 1
        share = diffusivity * DURATION / FRAMES * CELLS**2  # stable steps are at most 0.2
        self._steps = int(np.ceil(share / 0.2))
        self._rate = share / self._steps

    def step(self):
        """Simulate until the next frame."""
        for _ in range(self._steps):
            near = np.pad(self._temperature, 1, mode="edge")
            around = near[2:, 1:-1] + near[:-2, 1:-1] + near[1:-1, 2:] + near[1:-1, :-2]
            self._temperature = self._temperature + self._rate * (around - 4 * self._temperature)
        self._frame += 1
        time = 2 * self._frame / FRAMES - 1
        self.set_training_data(input=[*self._scaled, time], temperature=self._temperature)
