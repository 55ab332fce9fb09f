"""Logs of an arm with hidden parameters, on any engine."""

import numpy as np
from scipy.signal import lfilter

from physx_dart import DartBackend, PinocchioBackend
from physx_identify import Log
from physx_mujoco import MujocoBackend
from physx_sim import JointSettings, Robot, World

ENGINES = (PinocchioBackend, DartBackend, MujocoBackend)
JOINTS = ("shoulder", "elbow")
PERIOD = 0.005
HIDDEN = {
    "mass upper": 1.0,
    "mass lower": 1.2,
    "damping shoulder": 0.1,
    "damping elbow": 0.05,
    "friction shoulder": 0.2,
    "friction elbow": 0.1,
}
"""Parameters of the arm that makes the logs; the known arm has the masses 1 and 1 kg, and damping
of 0.02 N m s/rad."""
KNOWN = Robot("double_pendulum")


def hidden(**more):
    """Return the arm with the hidden parameters."""
    settings = {
        joint: JointSettings(
            damping=HIDDEN[f"damping {joint}"], friction=HIDDEN[f"friction {joint}"], **more
        )
        for joint in JOINTS
    }
    return Robot("double_pendulum", joints=settings, mass_factors={"lower": 1.2})


def motion(samples, seed=1):
    """Return targets and their velocities, shape (samples, joints)."""
    random, time = np.random.default_rng(seed), np.arange(samples) * PERIOD
    begin = np.clip(time / 0.8, 0, 1)[:, None]
    ramp = begin**3 * (10 - 15 * begin + 6 * begin**2)
    rates = 2 * np.pi * np.linspace(0.2, 1.7, 6)
    sizes, phases = random.normal(size=(2, 6)) * 0.3, random.uniform(0, 6.28, (2, 6))
    moved = np.stack(
        [
            np.sin(np.outer(time, rates) + phase) @ size
            for size, phase in zip(sizes, phases, strict=True)
        ],
        axis=1,
    )
    targets = ramp * (moved - moved[0])
    return targets, np.gradient(targets, PERIOD, axis=0)


def simulated(robot=None, samples=600, engine=PinocchioBackend):
    """Return positions and torques of an arm that tracks a motion, each (samples, joints)."""
    simulation = engine().build(World([robot or hidden()], period=PERIOD))
    targets, speeds = motion(samples)
    positions, torques = np.empty((2, samples, 2))
    stiff, damped = np.array([40.0, 10.0]), np.array([4.0, 0.5])
    for row in range(samples):
        positions[row] = simulation.positions()
        errors = targets[row] - positions[row], speeds[row] - simulation.velocities()
        torques[row] = stiff * errors[0] + damped * errors[1]
        simulation.set_commands(torques[row])
        simulation.step(1)
    return positions, torques


def noisy(clean, encoder=1e-4, torque=0.05, correlation=0.0, seed=0, joints=JOINTS):
    """Return a log with noise: of encoders in rad, of torques relative to their deviation."""
    positions, torques = clean
    random = np.random.default_rng(seed)
    white = random.normal(size=(len(torques) + 400, len(joints)))
    white *= np.sqrt(1 - correlation**2)
    colored = lfilter([1.0], [1.0, -correlation], white, axis=0)[400:]
    return Log(
        joints,
        PERIOD,
        positions + encoder * random.normal(size=positions.shape),
        torques + torque * torques.std(axis=0) * colored,
    )
