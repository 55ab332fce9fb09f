"""Actuator networks: what a log has beyond the torques of the identified robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from physx_core.errors import MissingLibraryError
from physx_identify.errors import IdentificationError
from physx_identify.estimation.model import GRAVITY, Model
from physx_identify.estimation.model import Path as Motion
from physx_identify.estimation.smooth import Smoother
from physx_identify.logs.log import Log
from physx_identify.result.identification import Identification
from physx_sim import Robot, write_actuators

if TYPE_CHECKING:
    from physx_torch import LearnedActuator


@dataclass(frozen=True, eq=False)
class Actuators:
    """Networks of the actuators of a robot.

    Attributes:
        learned: The network of each joint, and how good it is on the held-out end of the log.
        units: Unit of the torque of each joint.
    """

    learned: Mapping[str, LearnedActuator]
    units: Mapping[str, str]

    def __str__(self) -> str:
        lines = ["Beyond the robot's model, in the last fifth of the log, which no network saw:"]
        for joint, each in self.learned.items():
            unit = self.units[joint]
            lines.append(
                f"  {joint}: {each.without:.4g} {unit} (rms), {each.left:.4g} with its network"
            )
        return "\n".join(lines)


def learn_actuators(
    found: Identification,
    log: Log,
    robot: Robot,
    *,
    gravity: Sequence[float] = GRAVITY,
    held: Sequence[str] = (),
    samples: int = 5,
    seed: int = 0,
) -> Actuators:
    """Learn what actuators exert beyond their commands, from the log of an identification.

    What is left is the torque that the identified robot needs along the smoothed path, minus the
    logged one. Encoder noise that smoothing does not remove is in it, too.

    Args:
        found: The identification; the robot of the simulation must have its values.
        log: Its log.
        robot: The robot that it began with.
        gravity: In m/s².
        held: Joints that did not move.
        samples: Number of samples that each network sees.
        seed: Seed of weights and batches.

    Raises:
        IdentificationError: If what was unknown of the robot is nothing that a robot can be given,
            the base floats, something touches the robot, or the log is too short.
        MissingLibraryError: If `physx_torch` is not installed.
    """
    try:
        from physx_torch import learn_actuator
    except ImportError as error:
        raise MissingLibraryError(
            "An actuator network", "physx-torch", "actuator", "physx-identify"
        ) from error

    model = Model(found.applied_to(robot), gravity, held)
    model.check_fixed("Actuator networks")
    log.check_no_contacts("Actuator networks")
    path = Motion(Smoother(log.positions)(log.positions), log.period)
    needed = model.columns(path, model.numbers[:, None], path.ends)[:, :, 0]
    late = sum(each.value for each in found.estimates if each.kind == "delay")
    times = log.period * np.arange(len(log))
    sent = np.array([np.interp(times + max(late, 0.0), times, each) for each in log.torques.T]).T
    learned = {}
    for joint, own, command, speed in zip(
        model.joints, needed.T, sent[1:-1].T, path.velocities.T, strict=True
    ):
        try:
            learned[joint] = learn_actuator(
                command, speed, own - command, log.period, samples=samples, seed=seed
            )
        except ValueError as error:
            raise IdentificationError(f"{log.source}: {error}") from error
    units = dict(zip(model.joints, (_TORQUES[unit] for unit in model.units), strict=True))
    return Actuators(learned, units)


def write_learned(path: str | Path, actuators: Actuators) -> None:
    """Write the networks to a file that `Motor.network` names.

    Raises:
        ConfigError: If it cannot be written.
    """
    write_actuators(path, {joint: each.network for joint, each in actuators.learned.items()})


_TORQUES = {"rad": "N m", "m": "N"}
