"""A swinging Cosserat rod with PyElastica: many rows in a simulation."""

from __future__ import annotations

from pathlib import Path

import elastica as ea
import numpy as np

from physx_core import Environment, Field, Parameter

ELEMENTS, DENSITY, RADIUS = 20, 1000.0, 0.02
INTERVAL = 0.01
"""Time between two rows, in s."""


class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):
    """What the rod needs of PyElastica."""


class Rod(Environment):
    """A clamped rod of 1 m with a sudden force at its end, until it has settled or time is over."""

    independent_episodes = True

    def __init__(self, *, length=40, **kwargs):
        """Store the largest number of rows of a simulation."""
        super().__init__(**kwargs)
        self.length = length

    def create(self):
        """Define what differs between simulations."""
        young = Parameter("young", 3e5, 3e6, distribution="log_uniform", unit="Pa")
        force = Parameter("force", [-0.3] * 3, [0.3] * 3, shape=(3,), unit="N")
        self.define_parameters([young, force])

    def init_database(self):
        """Define a row."""
        shape = (ELEMENTS + 1, 3)
        position, velocity = Field("position", shape, unit="m"), Field("velocity", shape)
        self.define_training_fields([Field("given", (4,)), position, velocity])

    def reset_parameters(self, young, force):
        """Make a rod at rest."""
        note(self, "begins")
        self.given = [np.log(young), *force]
        self.steps = int(np.ceil(INTERVAL / (2e-4 * np.sqrt(3e5 / young))))
        self.rod = ea.CosseratRod.straight_rod(
            ELEMENTS,
            start=np.zeros(3),
            direction=np.array([1.0, 0, 0]),
            normal=np.array([0, 0, 1.0]),
            base_length=1.0,
            base_radius=RADIUS,
            density=DENSITY,
            youngs_modulus=young,
            shear_modulus=young / 3,
        )
        self.simulator = Simulator()
        self.simulator.append(self.rod)
        self.simulator.constrain(self.rod).using(
            ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
        )
        self.simulator.add_forcing_to(self.rod).using(
            ea.EndpointForces, np.zeros(3), np.array(force), ramp_up_time=0.1
        )
        self.simulator.dampen(self.rod).using(
            ea.AnalyticalLinearDamper, damping_constant=1.0, time_step=INTERVAL / self.steps
        )
        self.simulator.finalize()
        self.stepper, self.time = ea.PositionVerlet(), 0.0

    def step(self):
        """Simulate until the next row."""
        for _ in range(self.steps):
            self.time = self.stepper.step(self.simulator, self.time, INTERVAL / self.steps)
        position, velocity = self.rod.position_collection.T, self.rod.velocity_collection.T
        self.set_training_data(given=self.given, position=position, velocity=velocity)
        has_settled = self.time > 0.1 and np.abs(velocity).max() < 0.02
        if has_settled or self.step_index + 1 == self.length:
            note(self, "ends")
            self.end_episode()


def note(environment, what):
    """Log what a simulation does."""
    with Path("solver.log").open("a") as file:
        file.write(f"{environment.episode_index} {what}\n")
