"""``physx identify``: identify a robot's parameters from a log, with confidence intervals."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from physx_core.cli import options_from, show
from physx_identify import (
    Model,
    identify,
    learn_actuators,
    propose,
    read_log,
    store_identification,
    write_identification,
    write_learned,
    write_motion,
)
from physx_sim import Robot


@dataclass
class Identify:
    """Identify a robot's parameters from a log, with confidence intervals."""

    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    """File or folder with positions and torques of the joints: CSV, Parquet, npz, HDF5, MCAP (of
    ROS 2), a physx dataset, an episode's log, or a LeRobot dataset."""
    robot: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ROBOT")]
    """URDF or MJCF file, or the name of a robot; see physx robots."""
    free: tuple[str, ...] = ("mass", "damping", "friction")
    """What is unknown: mass, inertia, payload (of links); damping, friction, stribeck, armature,
    gain, bias, encoder (of joints); delay. mass:hand names one; mass:hand=0.7,0.1 is known to be
    0.7 +- 0.1 beforehand."""
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """TOML file with values, intervals and draws, which training can draw from."""
    actuator: str | None = None
    """File for networks of what actuators do beyond their commands and the robot's model, learned
    from the same log; Motor(network=FILE) adds it. Needs physx-identify[actuator]."""
    session: str | None = None
    """Folder that keeps the result, for physx report."""
    propose: str | None = None
    """CSV file for an excitation trajectory of the same length that would narrow the intervals."""
    period: float | None = None
    """Time between samples, in s; by default from the log's column of times."""
    columns: dict[str, str] = field(default_factory=dict)
    """Columns of positions, torques, velocities, time or, say, force.foot, where they have unusual
    names."""
    episode: int | None = None
    """Episode of a dataset with several."""
    topic: str | None = None
    """Topic of an MCAP file, such as /joint_states; by default the only one of all joints. Needs
    physx-identify[mcap]."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """In m/s^2."""
    held: tuple[str, ...] = ()
    """Joints that did not move and are not in the log, such as a gripper's: they are at 0."""
    floating: bool = False
    """The robot has a floating base, and the log has its pose: base_x, base_y, base_z, and base_qx,
    base_qy, base_qz, base_qw; or gyroscope_x ... and accelerometer_x ... of a sensor on it."""
    imu: str = ""
    """Frame on the base, such as imu_link, whose inertial sensor takes the place of the pose; by
    default it is in the frame of the base, and used if there is no pose."""
    axes: Literal["link", "world"] = "link"
    """Along which axes forces on links are: force.foot_x ... and moment.foot_x ..."""
    flight: bool = False
    """Nothing but gravity and the log's forces acts on the floating robot, so that the equations of
    its base count, too. Slow."""
    instant: bool = False
    """Torques are those at the instants of the samples, instead of held from each to the next."""
    engines: tuple[str, ...] = ()
    """Engines on which the values are fitted anew, such as dart and mujoco, to show which of them
    depend on the engine."""
    slowest: float = 0.02
    """Velocity in rad/s or m/s below which samples of joints with dry friction are left out."""
    level: float = 0.95
    """Nominal probability of the intervals."""
    json: bool = False
    """Print JSON instead of text."""


def run(words: Sequence[str]) -> None:
    """Print what the log says, and store it if requested."""
    options = options_from(Identify, words, "identify")
    robot = Robot(options.robot, fixed_base=not options.floating)
    begin = time.monotonic()
    model = Model(robot, options.gravity, options.held)
    log = read_log(
        options.log,
        model.joints,
        period=options.period,
        columns=options.columns,
        episode=options.episode,
        topic=options.topic,
        floating=model.floating,
        axes=options.axes,
    )
    found = identify(
        log,
        robot,
        options.free,
        level=options.level,
        gravity=options.gravity,
        held=options.held,
        instant=options.instant,
        engines=options.engines,
        slowest=options.slowest,
        flight=options.flight,
        imu=options.imu,
    )
    show(found, as_json=options.json)
    notes = []
    if log.left_out:
        notes.append(f"columns not used: {', '.join(log.left_out)}")
    if options.output is not None:
        write_identification(options.output, found)
        notes.append(f"identification: {options.output}")
    if options.actuator is not None:
        actuators = learn_actuators(found, log, robot, gravity=options.gravity, held=options.held)
        write_learned(options.actuator, actuators)
        notes += [*str(actuators).splitlines(), f"actuator networks: {options.actuator}"]
    if options.session is not None:
        store_identification(options.session, found, time.monotonic() - begin)
        notes.append(
            f"result: {options.session}; physx report {options.session} makes a page of it"
        )
    if options.propose is not None:
        motion = propose(found, robot, gravity=options.gravity, held=options.held)
        write_motion(options.propose, motion)
        notes += ["", *str(motion).splitlines(), f"motion: {options.propose}"]
    if not options.json:
        show("\n".join(["", *notes]) if notes else "")
