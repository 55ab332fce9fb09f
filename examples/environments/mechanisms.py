"""A four-bar linkage with its theory, and a gripper whose fingers are coupled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from environments.film import Scene

from physx_core.rotations import to_matrix
from physx_sim import Box, Connect, Ground, JointSettings, Mimic, Robot, World

HERE = Path(__file__).parent
FRAME, CRANK, COUPLER, ROCKER = 0.4, 0.12, 0.36, 0.28
"""Lengths of the bars, in m."""
LOOP = Connect("coupler", "rocker", (COUPLER, 0.0, 0.0), (ROCKER, -0.03, 0.0))
"""The pin between coupler and rocker."""
FRONT = {"eye": (0.17, -0.8, 0.4), "target": (0.17, 0.0, 0.37)}
SIDE = {"eye": (0.55, 0.3, 0.33), "target": (0.0, 0.0, 0.17)}
TRACER = np.array([COUPLER / 2, -0.01, 0.12])
"""Point of the coupler whose path is drawn, in its frame, in m."""


def four_bar() -> World:
    """Return a linkage whose crank is turned at the commanded velocity."""
    joints = {"crank": JointSettings(mode="velocity")}
    return World([Robot(HERE / "four_bar.urdf", joints=joints, position=(0, 0, 0.3))], 2e-3)


def theory(crank: float) -> np.ndarray:
    """Return the positions of the joints at an angle of the crank, in rad, shape (3,)."""
    pin = CRANK * np.exp(1j * crank)
    across = FRAME - pin
    inner = np.arccos((COUPLER**2 + abs(across) ** 2 - ROCKER**2) / (2 * COUPLER * abs(across)))
    coupler = np.angle(across) + inner
    rocker = np.angle(pin + COUPLER * np.exp(1j * coupler) - FRAME)
    return np.array([crank, coupler - crank, rocker])


def trace(scene: Scene) -> None:
    """Draw the way of a point of the coupler so far."""
    pose = scene.simulation.body_poses(["coupler"])[0]
    scene.trace = [*getattr(scene, "trace", ()), pose[:3] + to_matrix(pose[3:]) @ TRACER]
    if len(scene.trace) == 2:
        scene.factory.add_lines("trace", scene.trace, color="#ffd34d", size=0.003)
    elif len(scene.trace) > 2:
        scene.factory.update_lines("trace", positions=scene.trace)


def gripper(coupled: bool) -> World:
    """Return a gripper above a box; without coupling its right finger moves freely."""
    lift, follower = JointSettings(mode="position", gain=2.0), None if coupled else Mimic("")
    joints = {"lift": lift, "grip_right": JointSettings(mimic=follower)}
    robot = Robot(HERE / "gripper.urdf", joints=joints, position=(0, 0, 0.15))
    box = Box(name="box", size=(0.06, 0.08, 0.08), mass=0.5, position=(0, 0.01, 0.04))
    return World([robot], 2e-3, objects=[box], ground=Ground(friction=0.5))
