"""Logs of a robot that floats: a trunk with an arm of two links, in the air."""

from __future__ import annotations

import dataclasses

import logged_arm as arm
import numpy as np

from physx_core.rotations import from_rotation_vector_rows, multiply_rows
from physx_dart import PinocchioBackend
from physx_identify import Log
from physx_sim import Imu, JointSettings, Robot, Sensors, World, Wrench

FLYER = """
<mujoco><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 1"><freejoint/>
  <geom type="box" size="0.2 0.1 0.05" mass="2"/>
  <body name="imu" pos="0.1 -0.05 0.03" quat="0.8 0.36 0 0.48"/>
  <body name="upper" pos="0.1 0 -0.05"><joint name="shoulder" axis="0 1 0"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0.05 0.02 -0.3" mass="0.6"/>
    <body name="lower" pos="0.05 0.02 -0.3"><joint name="elbow" axis="1 0 0"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0.1 -0.25" mass="0.4"/>
      <body name="foot" pos="0 0.1 -0.25" quat="0.6 0 0.8 0"/></body></body>
</body></worldbody></mujoco>
"""
HIDDEN = {"mass lower": 0.5, "damping shoulder": 0.05, "damping elbow": 0.03,
          "friction shoulder": 0.1, "friction elbow": 0.05}  # fmt: skip


def flyer(place, **more):
    return Robot(str(place), fixed_base=False, **more)


def hidden(place, friction=True):
    joints = {
        name: JointSettings(
            damping=HIDDEN[f"damping {name}"], friction=friction * HIDDEN[f"friction {name}"]
        )
        for name in arm.JOINTS
    }
    return flyer(place, mass_factors={"lower": 1.25}, joints=joints)


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


def flown(robot, samples, engine=PinocchioBackend, lift=0.0, push=None):
    """Return what a robot does that tumbles while its joints track a motion.

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


def noisy(flight, base=1e-3, encoder=1e-4, torque=0.02, inertial=(0.0, 0.0), drift=0.0, force=0.0):
    """Return a log with noise: of poses, encoders, torques, and of the sensors.

    Args:
        flight: The motion.
        base: Noise of the pose, in m and rad.
        encoder: Of encoders, in rad.
        torque: Of torques, relative to their deviation.
        inertial: Of specific forces, in m/s², and angular velocities, in rad/s.
        drift: Constant error of the latter, in rad/s.
        force: Of forces, in N, ten times that of moments.
    """
    q, torques = flight.q, flight.torques
    random, count = np.random.default_rng(0), len(q)
    turns = from_rotation_vector_rows(base * random.normal(size=(count, 3)))
    signs = np.where(np.arange(count) % 7 < 3, -1, 1)[:, None]  # a quaternion has two
    positions = q[:, 7:] + encoder * random.normal(size=(count, 2))
    torques = torques + torque * torques.std(axis=0) * random.normal(size=(count, 2))
    places = q[:, :3] + base * random.normal(size=(count, 3))
    read = flight.inertial + np.repeat(inertial, 3) * random.normal(size=(count, 6))
    felt = flight.wrench + force * np.repeat([1, 0.1], 3) * random.normal(size=(count, 6))
    pushed = flight.wrench.any()
    return Log(
        arm.JOINTS,
        arm.PERIOD,
        positions,
        torques,
        base_positions=places,
        base_orientations=signs * multiply_rows(q[:, 3:7], turns),
        gyroscope=read[:, 3:] + drift,
        accelerometer=read[:, :3],
        wrenches={"foot": felt} if pushed else {},
        axes="world" if pushed else "link",
    )
