"""A double pendulum that swings under smooth random torques."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from physx_core import Field, plugins
from physx_core.components import Environment
from physx_core.errors import ConfigError
from physx_dart.environments.trajectories import SmoothTrajectory
from physx_sim import Robot, Simulation, World
from physx_sim.engines import OWN_ROBOTS

URDF = OWN_ROBOTS / "double_pendulum.urdf"
"""Two links of 1 kg and 0.5 m that hang down at zero."""


class DoublePendulumEnvironment(Environment):
    """A double pendulum with random initial states.

    Fields: ``state``, the angles and angular velocities of both joints; ``torque``, the torques at
    that instant; ``acceleration``, which follows from both. Without torques
    (``torque_amplitude=0``), the state alone determines the acceleration.

    Args:
        period: Length of a physics step, in s.
        steps_per_sample: Physics steps per step, under constant torque.
        episode_steps: Number of steps after which the pendulum is reset.
        torque_amplitude: Largest torque, in N m.
    """

    backend: ClassVar[str] = "dart"

    def __init__(
        self,
        *,
        period: float = 1e-3,
        steps_per_sample: int = 10,
        episode_steps: int = 200,
        torque_amplitude: float = 1.0,
        **kwargs: Any,
    ) -> None:
        """Store the options.

        Raises:
            ConfigError: If a number of steps is less than 1.
        """
        super().__init__(**kwargs)
        if steps_per_sample < 1 or episode_steps < 1:
            raise ConfigError("steps_per_sample and episode_steps must be at least 1.")
        self.period, self.steps_per_sample = period, steps_per_sample
        self._episode_steps, self.torque_amplitude = episode_steps, torque_amplitude
        self.step_time = period * steps_per_sample
        self._steps = 0

    def create(self) -> None:
        """Build the simulation."""
        world = World([Robot(URDF, "pendulum")], period=self.period)
        self.simulation: Simulation = plugins.resolve("backend", self.backend).build(world)

    def init_database(self) -> None:
        """Define the fields."""
        self.define_training_fields(
            [
                Field("state", shape=(4,), unit="rad, rad/s"),
                Field("torque", shape=(2,), unit="N m"),
                Field("acceleration", shape=(2,), unit="rad/s^2"),
            ]
        )

    def init_visualization(self) -> None:
        """Add the pendulum."""
        bodies, poses = self.simulation.layout.bodies, self.simulation.body_poses()
        self.factory.add_robot("pendulum", str(URDF), bodies, poses=poses)

    def step(self) -> None:
        """Simulate the physics steps of a sample, or replay a stored sample."""
        if self.sample is not None:
            self.simulation.set_state(self.sample["state"][:2], self.sample["state"][2:])
            names = ("state", "torque", "acceleration")
            self.set_training_data(**{name: self.sample[name] for name in names})
        else:
            self._simulate()
        if self.factory:
            self.factory.update_robot("pendulum", poses=self.simulation.body_poses())

    def close(self) -> None:
        """Free the simulation."""
        if hasattr(self, "simulation"):
            self.simulation.close()

    def _simulate(self) -> None:
        simulation = self.simulation
        if self._steps % self._episode_steps == 0:
            if self._steps:
                self.new_episode()
            simulation.set_state(self.rng.uniform(-np.pi, np.pi, 2), self.rng.uniform(-3, 3, 2))
            limit = np.full(2, self.torque_amplitude)
            self._torques = SmoothTrajectory.draw(self.rng, np.zeros(2), limit, (0.2, 2.0))
            self._begin = simulation.frame
        torque, _, _ = self._torques.at((simulation.frame - self._begin) * self.period)
        simulation.set_torques(torque)
        simulation.step(self.steps_per_sample)
        q, v = simulation.positions(), simulation.velocities()
        a = simulation.forward_dynamics(q, v, torque)
        self.set_training_data(state=np.concatenate([q, v]), torque=torque, acceleration=a)
        self._steps += 1


class DartDoublePendulum(DoublePendulumEnvironment):
    """The double pendulum in DART."""

    backend = "dart"


class PinocchioDoublePendulum(DoublePendulumEnvironment):
    """The double pendulum in Pinocchio."""

    backend = "pinocchio"
