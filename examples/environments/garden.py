"""A garden of posts, and a robot on wheels that scans it with a lidar."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from physx_core.rotations import to_matrix
from physx_sim import Box, Cylinder, Ground, JointSettings, Lidar, Robot, Simulation, World, fan

GOAL, REACH, TURNS = np.array([6.0, 0.0]), 2.5, np.radians(np.linspace(-100, 100, 41))
"""Where to go, in m; the range of the lidar, in m; the angles of its rays, in rad."""
VIEW = {"eye": (1.0, -3.6, 6.0), "target": (3.0, 0.0, 0.0)}
_RADIUS, _TRACK = 0.1, 0.4  # of the wheels and between them, in m


def lidar() -> Lidar:
    """Return the lidar, at the front of the robot's base."""
    where = {"body": "base", "position": (0.2, 0.0, 0.1)}
    return Lidar(name="lidar", directions=fan(TURNS), reach=REACH, **where)


def garden(number: int) -> World:
    """Return the robot, a wall, and 10 posts between it and the goal, at random."""
    rng, things = np.random.default_rng(number), []
    while len(things) < 10:
        place = rng.uniform((1.0, -1.8), (5.2, 1.8))
        near = [np.hypot(*(place - thing.position[:2])) for thing in things]
        if min(near, default=9.0) > 1.15:
            name, spot = f"post {len(things)}", (*place, 0.2)
            things.append(Cylinder(name=name, radius=0.12, length=0.4, static=True, position=spot))
    wall = Box(name="wall", size=(0.2, 0.8, 0.4), static=True, position=(1.6, 0.0, 0.2))
    wheels = ("left_wheel_joint", "right_wheel_joint")
    joints = {name: JointSettings(mode="servo") for name in wheels}
    robot = Robot("wheeled_base", fixed_base=False, position=(0, 0, 0.15), joints=joints)
    return World([robot], 5e-3, objects=[wall, *things], ground=Ground())


def drive(simulation: Simulation, speed: float, turn: float) -> None:
    """Drive ahead at a speed in m/s and turn to the left in rad/s."""
    commands = dict.fromkeys(simulation.layout.joints, 0.0)
    commands["left_wheel_joint"] = (speed - 0.5 * _TRACK * turn) / _RADIUS
    commands["right_wheel_joint"] = (speed + 0.5 * _TRACK * turn) / _RADIUS
    simulation.set_commands(list(commands.values()))


def bearing(simulation: Simulation) -> tuple[float, float]:
    """Return the distance of the goal, in m, and its direction as seen from the robot, in rad."""
    pose = simulation.body_poses(["base"])[0]
    away, ahead = GOAL - pose[:2], to_matrix(pose[3:])[:2, 0]
    angle = np.arctan2(away[1], away[0]) - np.arctan2(ahead[1], ahead[0])
    return float(np.hypot(*away)), float(np.angle(np.exp(1j * angle)))


def rays(simulation: Simulation, distances: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the rays of the lidar up to what they hit, shape (2, 3) each, in m."""
    pose = simulation.body_poses(["base"])[0]
    turn, begin = to_matrix(pose[3:]), pose[:3] + to_matrix(pose[3:]) @ (0.2, 0, 0.1)
    for direction, distance in zip(fan(TURNS), distances, strict=True):
        yield np.stack([begin, begin + distance * turn @ direction])
