"""Logs of a robot that tumbles through the air while its two joints track a motion."""

import dataclasses
from pathlib import Path

import logged_arm as arm
import numpy as np

from physx_core.rotations import from_rotation_vector_rows, multiply_rows
from physx_dart import PinocchioBackend
from physx_sim import Imu, JointSettings, Robot, Sensors, World, Wrench

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
    flight = pushed(robot, samples, engine)
    return flight.q, flight.torques


@dataclasses.dataclass
class Flight:
    """What a robot in the air does, without noise; one row a sample.

    Attributes:
        q: Pose of the base, and positions of the joints.
        torques: Of the joints.
        inertial: Specific force and angular velocity of the frame imu, along its axes.
        wrench: Force and moment on the foot in the world, of the step before.
    """

    q: np.ndarray
    torques: np.ndarray
    inertial: np.ndarray
    wrench: np.ndarray


def pushed(robot, samples, engine=PinocchioBackend, lift=0.0, push=None):
    """Return the flight of a robot on which forces act.

    Args:
        robot: The robot.
        samples: How many.
        engine: Of which engine.
        lift: Force on the trunk, in N.
        push: Function from a time in s to force and moment on the foot; None: nothing pushes it.
    """
    world = World([robot], period=arm.PERIOD)
    simulation = engine().build(world)
    turn = np.array([0.36, 0.0, 0.48, 0.8]) / np.linalg.norm([0.36, 0.0, 0.48, 0.8])
    sensor = Imu(name="imu", body="trunk", position=(0.1, -0.05, 0.03), rotation=tuple(turn))
    sensors = Sensors(simulation, world, [sensor])
    begin = np.array([0, 0, 1.0, 0.7, -0.5, 0.9, 0, 0])
    simulation.set_state(simulation.positions(), begin)
    if lift:
        simulation.apply_wrench(Wrench("trunk", force=(0.0, 0.0, lift)))
    targets, speeds = arm.motion(samples)
    q, torques = np.empty((samples, 9)), np.empty((samples, 2))
    inertial, wrench = np.zeros((samples, 6)), np.zeros((samples + 1, 6))
    for row in range(samples):
        sensors.update(simulation)
        read = sensors["imu"]
        inertial[row] = [*read["acceleration"], *read["angular_velocity"]]
        q[row] = simulation.positions()
        torques[row] = [12, 4] * (targets[row] - q[row, 7:])
        torques[row] += [1, 0.2] * (speeds[row] - simulation.velocities()[6:])
        simulation.set_commands(torques[row])
        if push is not None:
            wrench[row + 1] = push(row * arm.PERIOD)
            force, moment = (tuple(each) for each in np.split(wrench[row + 1], 2))
            simulation.apply_wrench(Wrench("foot", force, moment, duration=arm.PERIOD))
        simulation.step(1)
    return Flight(q, torques, inertial, wrench[:-1])


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


def sensed(flight, inertial=(0.0, 0.0), drift=0.0, force=0.0, **more):
    """Return a log with the pose, an inertial sensor, and forces if there are any.

    Args:
        flight: The motion.
        inertial: Noise of specific forces, in m/s², and angular velocities, in rad/s.
        drift: Constant error of the latter, in rad/s.
        force: Noise of forces, in N, ten times that of moments.
        **more: As of `noisy`.
    """
    random, count = np.random.default_rng(0), len(flight.q)
    read = flight.inertial + np.repeat(inertial, 3) * random.normal(size=(count, 6))
    felt = flight.wrench + force * np.repeat([1, 0.1], 3) * random.normal(size=(count, 6))
    touched = flight.wrench.any()
    return dataclasses.replace(
        noisy((flight.q, flight.torques), **more),
        gyroscope=read[:, 3:] + drift,
        accelerometer=read[:, :3],
        wrenches={"foot": felt} if touched else {},
        axes="world" if touched else "link",
    )
