"""Logs of a leg of two links whose foot strikes the ground, for 2 s."""

import dataclasses

import logged_arm as arm
import numpy as np

from physx_dart import PinocchioBackend
from physx_identify import Log
from physx_sim import Ground, JointSettings, Robot, World

HIDDEN = {
    "mass upper": 0.3,
    "mass lower": 0.36,
    "damping shoulder": 0.1,
    "damping elbow": 0.1,
    "friction shoulder": 0.2,
    "friction elbow": 0.2,
}
"""Parameters of the leg that makes the logs."""
KNOWN = Robot("acrobot", mass_factors={"upper": 0.3, "lower": 0.3})


def hidden():
    """Return the leg with the hidden parameters."""
    joints = {joint: JointSettings(damping=0.1, friction=0.2) for joint in arm.JOINTS}
    return Robot("acrobot", joints=joints, mass_factors={"upper": 0.3, "lower": 0.36})


def stepping(engine=PinocchioBackend):
    """Return motion, torques, and what the ground exerts on the lower link.

    Returns:
        Positions and torques, shape (400, 2); and the force and the moment about the link's origin
        along the world's axes, in the step before each sample, shape (400, 6).
    """
    world = World([hidden()], ground=Ground(height=-1.85), period=arm.PERIOD, contacts="static")
    simulation = engine().build(world)
    lower = simulation.layout.names.index("lower")
    moments = np.arange(500) * arm.PERIOD
    elbow = 1.1 + 0.5 * np.sin(5.0 * moments) + 0.2 * np.sin(8.0 * moments)
    targets = np.stack([0.25 * np.sin(3.8 * moments) - 0.5 * elbow, elbow], axis=1)
    speeds = np.gradient(targets, arm.PERIOD, axis=0)
    simulation.set_state(targets[0], speeds[0])
    positions, torques = np.empty((2, *targets.shape))
    wrenches = np.zeros((len(targets) + 1, 6))
    for row, (target, speed) in enumerate(zip(targets, speeds, strict=True)):
        positions[row] = simulation.positions()
        errors = target - positions[row], speed - simulation.velocities()
        torques[row] = np.array([90, 30]) * errors[0] + np.array([9, 2.4]) * errors[1]
        simulation.set_commands(torques[row])
        origin = simulation.body_poses(["lower"])[0, :3]
        simulation.step(1)
        for each in simulation.contacts():
            force = each["force"] if each["body_a"] == lower else -each["force"]
            wrenches[row + 1, :3] += force
            wrenches[row + 1, 3:] += np.cross(each["point"] - origin, force)
    return positions[100:], torques[100:], wrenches[100:-1]


def sensed(clean, force=0.5, correlation=0.9, seed=0):
    """Return a log with noise whose wrenches are measured, with noise of the force in N.

    That of the moment is a tenth of it, in N m.
    """
    *moved, wrenches = clean
    log = arm.noisy(moved, correlation=correlation, seed=seed)
    noise = force * np.repeat([1.0, 0.1], 3)
    wrenches = wrenches + noise * np.random.default_rng(seed + 10**6).normal(size=wrenches.shape)
    return dataclasses.replace(log, wrenches={"lower": wrenches}, axes="world")


def flagged(clean, correlation=0.9, seed=0):
    """Return a log with noise that has only where the leg touches the ground."""
    *moved, wrenches = clean
    log: Log = arm.noisy(moved, correlation=correlation, seed=seed)
    return dataclasses.replace(log, contacts={"lower": wrenches.any(axis=1)})
