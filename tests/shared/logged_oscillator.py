"""Logs of a pendulum, pushed near its own frequency by a torque that does not look at it."""

import numpy as np
from logged_arm import PERIOD

from physx_dart import PinocchioBackend
from physx_sim import JointSettings, Robot, World
from physx_sim.conformance.worlds import PENDULUM

JOINTS = ("hinge",)
HIDDEN = {"mass bar": 2.4, "damping hinge": 0.3, "friction hinge": 0.15}
"""Parameters of the pendulum that makes the logs; the known one has 2 kg and no resistance."""
KNOWN = Robot(str(PENDULUM))


def simulated(samples=800, engine=PinocchioBackend):
    """Return positions and torques, each (samples, 1): swings of 1 rad at about 0.6 Hz."""
    settings = JointSettings(damping=HIDDEN["damping hinge"], friction=HIDDEN["friction hinge"])
    robot = Robot(str(PENDULUM), joints={"hinge": settings}, mass_factors={"bar": 1.2})
    simulation = engine().build(World([robot], period=PERIOD))
    time = np.arange(samples)[:, None] * PERIOD
    rates, phases = 2 * np.pi * np.array([0.3, 0.5, 0.7, 1.1, 1.7]), np.arange(5)
    torques = np.sin(time * rates + phases) @ np.array([[1.5], [1.5], [1.5], [2.0], [2.0]])
    positions = np.empty((samples, 1))
    simulation.set_state([0.6], [0.0])
    for row in range(samples):
        positions[row] = simulation.positions()
        simulation.set_commands(torques[row])
        simulation.step(1)
    return positions, torques
