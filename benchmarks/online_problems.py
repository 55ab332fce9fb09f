"""Environments for `benchmarks/online.py`."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from physx_core import Environment, Field, Parameter

POINTS, PERIOD = 50, 0.02
Vector = np.ndarray


class Costly(Environment):
    """A simulation whose step takes a given processor time."""

    def __init__(self, *, cost: float, **kwargs: Any) -> None:
        """Set the cost of a step, in s."""
        super().__init__(**kwargs)
        self._cost = cost

    def create(self) -> None:
        """Create nothing."""

    def init_database(self) -> None:
        """Define an input and an output field."""
        self.define_training_fields([Field("input", shape=(8,)), Field("output", shape=(1,))])

    def step(self) -> None:
        """Keep the processor busy, then set a sample."""
        until = time.perf_counter() + self._cost
        while time.perf_counter() < until:
            pass
        x = self.rng.normal(size=8)
        self.set_training_data(input=x, output=x[:1] * x[1:2])


class Large(Environment):
    """Samples with many numbers."""

    def __init__(self, *, size: int, **kwargs: Any) -> None:
        """Set how many."""
        super().__init__(**kwargs)
        self._size = size

    def create(self) -> None:
        """Create nothing."""

    def init_database(self) -> None:
        """Define an input and an output field."""
        fields = [Field("input", (self._size,), "float32"), Field("output", (1,), "float32")]
        self.define_training_fields(fields)

    def step(self) -> None:
        """Draw numbers."""
        x = self.rng.random(self._size, np.float32)
        self.set_training_data(input=x, output=x[:1])


class Lorenz(Environment):
    """Trajectories of the Lorenz system, with random coefficients and initial states.

    A sample is a state with the coefficients, and the change of the state in 20 ms.
    """

    episode_steps = POINTS

    def create(self) -> None:
        """Define coefficients and initial states."""
        self.define_parameters(
            [
                Parameter("coefficients", [8.0, 20.0, 2.0], [12.0, 35.0, 3.0], shape=(3,)),
                Parameter("begin", [-15.0, -20.0, 5.0], [15.0, 20.0, 40.0], shape=(3,)),
            ]
        )

    def init_database(self) -> None:
        """Define an input and an output field."""
        self.define_training_fields([Field("input", shape=(6,)), Field("output", shape=(3,))])

    def reset_parameters(self, coefficients: Vector, begin: Vector) -> None:
        """Start a trajectory."""
        self._coefficients, self._state = coefficients, begin

    def step(self) -> None:
        """Make a step of the classic Runge-Kutta method."""
        state, half = self._state, PERIOD / 2
        first = self._speed(state)
        second = self._speed(state + half * first)
        third = self._speed(state + half * second)
        fourth = self._speed(state + PERIOD * third)
        change = PERIOD / 6 * (first + 2 * second + 2 * third + fourth)
        self._state = state + change
        self.set_training_data(input=[*state, *self._coefficients], output=change)

    def _speed(self, state: Vector) -> Vector:
        (sigma, rho, beta), (x, y, z) = self._coefficients, state
        return np.array([sigma * (y - x), x * (rho - z) - y, x * y - beta * z])


class Resonance(Environment):
    """The response of a damped oscillator to a periodic force, one sample per simulation.

    Near the resonance and with little damping, it is large and changes quickly: a small part of the
    range of parameters.
    """

    episode_steps = 1

    def create(self) -> None:
        """Define frequency, in natural frequencies, and damping, relative to critical damping."""
        self.define_parameters([Parameter("frequency", 0.2, 3.0), Parameter("damping", 0.03, 0.4)])

    def init_database(self) -> None:
        """Define an input and an output field."""
        self.define_training_fields([Field("input", shape=(2,)), Field("output", shape=(2,))])

    def reset_parameters(self, frequency: float, damping: float) -> None:
        """Store the parameters."""
        self._frequency, self._damping = frequency, damping

    def step(self) -> None:
        """Compute the parts of the response in phase with the force and a quarter period behind."""
        response = 1 / (1 - self._frequency**2 + 2j * self._damping * self._frequency)
        scaled = [(self._frequency - 1.6) / 1.4, (self._damping - 0.2) / 0.2]
        self.set_training_data(input=scaled, output=[response.real, response.imag])


class Uneven(Resonance):
    """The same problem, with simulations of very different durations, which are stored."""

    def init_database(self) -> None:
        """Define a field for the duration, too."""
        super().init_database()
        self.define_additional_fields(Field("seconds", shape=()))

    def step(self) -> None:
        """Wait for a log-normal time of median 50 ms, then compute."""
        seconds = 0.05 * self.rng.lognormal(sigma=1.2)
        time.sleep(seconds)
        super().step()
        self.set_additional_data(seconds=seconds)


class Late(Resonance):
    """The same problem, with simulations whose duration varies from run to run."""

    def create(self) -> None:
        """Define the same parameters, and unseeded delays."""
        super().create()
        self._delays = np.random.default_rng()

    def step(self) -> None:
        """Wait now and then, then compute."""
        if self._delays.random() < 0.2:
            time.sleep(self._delays.exponential(0.01))
        super().step()
