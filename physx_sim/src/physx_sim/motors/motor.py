"""Description of a motor: plain, picklable data."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from physx_core import checks
from physx_core.errors import ConfigError
from physx_sim.description.robot import JointSettings
from physx_sim.description.world import World


@dataclass(frozen=True, kw_only=True)
class Motor:
    """A motor with its gear, on a torque-driven joint.

    Command, torque, velocity, friction and inertia are those of the motor's shaft. The joint turns
    `reduction` times slower with a torque `reduction` times higher. For a prismatic joint, read N
    for N m and m for rad on the joint side of the gear.

    The commanded torque is clipped to `max_torque` and, close to `max_velocity`, to
    ``slope * (max_velocity - velocity)``, and never drives the shaft beyond `max_velocity`; then
    friction is subtracted. Dry friction of a rigid gear is ``dry * tanh(velocity /
    dry_velocity)``, so it creeps; for friction that sticks, use `JointSettings.friction` or an
    elastic gear.

    Without `stiffness` the gear is rigid and `inertia` belongs in the engine's mass matrix, added
    by `with_rotors`, on engines with the feature ``armature``. With `stiffness` the rotor is a
    separate body, simulated here, that drives the joint through a spring and damper, possibly with
    `backlash`. This works on all engines, including with contacts.

    Attributes:
        joint: Name of the joint in `Layout.joints`.
        max_torque: In N m; inf: only the joint's own limit applies.
        max_velocity: Velocity at which the torque vanishes, in rad/s; inf: no limit.
        slope: Slope of the torque limit near `max_velocity`, in N m s/rad; inf: a step.
        viscous: Viscous friction, in N m s/rad; a pair: forward, backward.
        dry: Dry friction, in N m; a pair: forward, backward.
        dry_velocity: Velocity at which 76 % of the dry friction acts, in rad/s.
        reduction: Motor turns per joint turn; negative: in the opposite direction.
        inertia: Inertia of the rotor, in kg m².
        stiffness: Stiffness of the gear at the joint, in N m/rad; None: rigid.
        damping: Damping of an elastic gear at the joint, in N m s/rad.
        backlash: Play of an elastic gear at the joint, from one flank to the other, in rad.
        period: Time between updates of the motor's command and measured velocity, in s; a
            multiple of the physics period; None: at every physics step.
        network: File of ``physx identify --actuator``, whose network for the joint adds what the
            real actuator does beyond all this, for a rigid gear; None: nothing.

    Raises:
        ConfigError: If the joint is not a name, a number is out of range, there is damping or
            backlash without `stiffness`, or a network with it.
    """

    joint: str
    max_torque: float = math.inf
    max_velocity: float = math.inf
    slope: float = math.inf
    viscous: float | tuple[float, float] = 0.0
    dry: float | tuple[float, float] = 0.0
    dry_velocity: float = 0.01
    reduction: float = 1.0
    inertia: float = 0.0
    stiffness: float | None = None
    damping: float = 0.0
    backlash: float = 0.0
    period: float | None = None
    network: str | None = None

    def __post_init__(self) -> None:
        where = f'Motor of "{self.joint}": '
        if not isinstance(self.joint, str):
            raise ConfigError(f"{where}joint must be a name.")
        checks.store_declared(where, self)
        checks.options(_positive_or_inf, where, self, "max_torque", "max_velocity", "slope")
        checks.options(checks.not_negative, where, self, "inertia", "damping", "backlash")
        for option in ("viscous", "dry"):
            object.__setattr__(self, option, _both_ways(where + option, getattr(self, option)))
        checks.positive(f"{where}dry_velocity", self.dry_velocity)
        if not checks.finite(f"{where}reduction", self.reduction):
            raise ConfigError(f"{where}reduction must not be 0.")
        if self.period is not None:
            checks.positive(f"{where}period", self.period)
        if self.stiffness is not None:
            if self.network is not None:
                raise ConfigError(f"{where}a network needs a rigid gear, without stiffness.")
            checks.positive(f"{where}stiffness", self.stiffness)
            checks.positive(f"{where}inertia, with stiffness,", self.inertia)
        elif self.damping or self.backlash:
            raise ConfigError(f"{where}damping and backlash need the gear's stiffness.")

    @property
    def armature(self) -> float:
        """The rotor's inertia as seen from the joint, in kg m² or kg."""
        return self.inertia * self.reduction**2


def with_rotors(world: World, motors: Sequence[Motor]) -> World:
    """Return the world with the rotors of rigid-gear motors added to its joints' armature.

    A file's own armature is that of its motor, so it is replaced.

    Engines without the feature ``armature`` cannot build it.

    Raises:
        ConfigError: If a motor's joint does not belong to a robot of the world.
    """
    robots = list(world.robots)
    for motor in motors:
        if motor.stiffness is None and motor.inertia:
            place, joint = _robot_of(world, motor.joint)
            joints = dict(robots[place].joints)
            settings = joints.get(joint, JointSettings())
            armature = (settings.armature or 0.0) + motor.armature
            joints[joint] = dataclasses.replace(settings, armature=armature)
            robots[place] = dataclasses.replace(robots[place], joints=joints)
    return dataclasses.replace(world, robots=robots)


def armature_in(world: World, joint: str) -> float:
    """Return a joint's armature in a world, given the joint's name in the layout."""
    place, name = _robot_of(world, joint)
    return world.robots[place].joints.get(name, JointSettings()).armature or 0.0


def _robot_of(world: World, joint: str) -> tuple[int, str]:
    """Return the index of a joint's robot and the joint's name in the robot's file."""
    if len(world.robots) == 1:
        return 0, joint
    owner, _, name = joint.partition("/")
    for place, robot in enumerate(world.robots):
        if robot.name == owner:
            return place, name
    raise ConfigError(
        f'The motor\'s joint "{joint}" does not belong to any of the robots '
        f"{[robot.name for robot in world.robots]}: write <robot>/<joint>."
    )


def _positive_or_inf(option: str, value: Any) -> float:
    return math.inf if value == math.inf else checks.positive(option, value)


def _both_ways(option: str, value: Any) -> tuple[float, float]:
    pair = value if isinstance(value, (tuple, list)) else (value, value)
    forward, backward = checks.vector(option, pair, 2)
    return checks.not_negative(option, forward), checks.not_negative(option, backward)
