"""Logs of a robot that tumbles through the air while its two joints track a motion."""

import dataclasses
from pathlib import Path

import logged_arm as arm
import numpy as np

from physx_core.rotations import from_rotation_vector_rows, multiply_rows
from physx_dart import PinocchioBackend
from physx_sim import JointSettings, Robot, World

FILE = Path(__file__).with_name("flyer.xml")
HIDDEN = {
    "mass lower": 0.5,
    "damping shoulder": 0.05,
    "damping elbow": 0.03,
    "friction shoulder": 0.1,
    "friction elbow": 0.05,
}
"""Parameters of the robot that makes the logs; the known one has 0.4 kg and no resistance."""
KNOWN = Robot(str(FILE), fixed_base=False)


def hidden(friction=True):
    """Return the robot with the hidden parameters, or without dry friction."""
    joints = {
        name: JointSettings(
            damping=HIDDEN[f"damping {name}"], friction=friction * HIDDEN[f"friction {name}"]
        )
        for name in arm.JOINTS
    }
    return dataclasses.replace(KNOWN, mass_factors={"lower": 1.25}, joints=joints)


def flown(robot, samples, engine=PinocchioBackend):
    """Return positions, shape (samples, 9), and torques, shape (samples, 2)."""
    simulation = engine().build(World([robot], period=arm.PERIOD))
    begin = np.array([0, 0, 1.0, 0.7, -0.5, 0.9, 0, 0])
    simulation.set_state(simulation.positions(), begin)
    targets, speeds = arm.motion(samples)
    q, torques = np.empty((samples, 9)), np.empty((samples, 2))
    for row in range(samples):
        q[row] = simulation.positions()
        torques[row] = [12, 4] * (targets[row] - q[row, 7:])
        torques[row] += [1, 0.2] * (speeds[row] - simulation.velocities()[6:])
        simulation.set_commands(torques[row])
        simulation.step(1)
    return q, torques


def noisy(clean, base=1e-3, encoder=1e-4, torque=0.02, correlation=0.0, seed=0):
    """Return a log with noise: of the base in m and rad, else as of `logged_arm.noisy`."""
    q, torques = clean
    log = arm.noisy((q[:, 7:], torques), encoder, torque, correlation, seed)
    random, count = np.random.default_rng([seed, 1]), len(q)
    turns = from_rotation_vector_rows(base * random.normal(size=(count, 3)))
    signs = np.where(np.arange(count) % 7 < 3, -1, 1)[:, None]  # a quaternion has two
    return dataclasses.replace(
        log,
        base_positions=q[:, :3] + base * random.normal(size=(count, 3)),
        base_orientations=signs * multiply_rows(q[:, 3:7], turns),
    )
