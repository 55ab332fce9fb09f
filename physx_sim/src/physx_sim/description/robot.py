"""Robots: a URDF or MJCF file plus the options that a world adds to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from physx_core import checks
from physx_core.errors import ConfigError, UnknownOptionError
from physx_sim.description.coupling import JointCoupling
from physx_sim.description.ground import MATERIAL
from physx_sim.description.wheel import Wheel

Mode = Literal["force", "servo", "velocity", "position"]
_RESISTANCE = ("damping", "friction", "stiffness", "rest", "armature")
Collisions = Literal["shapes", "boxes", "capsules", "none"]


@dataclass(frozen=True)
class Mimic:
    """How a joint follows another: its position is ``multiplier`` x the leader's + ``offset``.

    A follower takes no commands. Its motion, limits and resistance act on its leader.

    Attributes:
        leader: Name of the other joint in the file; empty: the joint moves freely.
        multiplier: In rad or m of the follower per rad or m of the leader; not 0.
        offset: Position of the follower where the leader's is 0, in rad or m.

    Raises:
        ConfigError: If an option has the wrong type, or the multiplier is 0.
    """

    leader: str
    multiplier: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.leader, str):
            raise ConfigError(f"Mimic.leader is {self.leader!r}, not the name of a joint.")
        checks.store_declared("Mimic.", self)
        checks.finite("Mimic.offset", self.offset)
        if not checks.finite("Mimic.multiplier", self.multiplier):
            raise ConfigError("Mimic.multiplier must not be 0.")


@dataclass(frozen=True)
class JointSettings:
    """Drive and resistance of a joint. None: as in the robot's file, 0 if it does not say.

    Attributes:
        mode: Meaning of a command to the joint. ``"force"``: a torque, in N m or N.
            ``"servo"``: a velocity, in rad/s or m/s, that the joint's motor reaches as far as its
            torque limit allows. ``"velocity"``: a velocity that is imposed on the joint.
            ``"position"``: a position, in rad or m, that a servo tracks.
        gain: In ``"position"`` mode, the servo's velocity per position error, in 1/s, clipped to
            the velocity limit; at most 1 / period.
        damping: Viscous damping, in N m s/rad or N s/m.
        friction: Coulomb friction, in N m or N.
        stiffness: Stiffness of a spring between the links, in N m/rad or N/m.
        rest: Rest position of the spring, in rad or m.
        armature: Inertia of the motor's rotor as seen from the joint, in kg m² or kg.
        mimic: How it follows another joint; ``Mimic("")``: it moves freely, whatever its file says.

    Raises:
        UnknownOptionError: If there is no such mode.
        ConfigError: If another option is out of range.
    """

    mode: Mode = "force"
    gain: float = 20.0
    damping: float | None = None
    friction: float | None = None
    stiffness: float | None = None
    rest: float | None = None
    armature: float | None = None
    mimic: Mimic | None = None

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise UnknownOptionError("JointSettings.mode", [str(self.mode)], get_args(Mode))
        if self.mimic is not None and not isinstance(self.mimic, Mimic):
            raise ConfigError(f"JointSettings.mimic is {self.mimic!r}, not a Mimic.")
        checks.store_declared("JointSettings.", self)
        checks.positive("JointSettings.gain", self.gain)
        if self.rest is not None:
            checks.finite("JointSettings.rest", self.rest)
        for option in ("damping", "friction", "stiffness", "armature"):
            value = getattr(self, option)
            if value is not None:
                checks.not_negative(f"JointSettings.{option}", value)

    def resistance(self, **file: float) -> dict[str, float]:
        """Return damping, friction, stiffness, rest and armature, completed from a file's."""
        given = {name: getattr(self, name) for name in _RESISTANCE}
        return {name: file.get(name, 0.0) if x is None else x for name, x in given.items()}


@dataclass(frozen=True)
class Robot:
    """A robot from a file; links and joints named in its options must exist in that file.

    Attributes:
        urdf: Path of its URDF or MJCF file, or the name of a robot: see ``physx robots``.
        name: Name of the robot in the world.
        root: In an MJCF file with several trees, the body that is the root link, or ``"world"`` for
            all that is attached to the world: see `mjcf_robots`.
        fixed_base: Whether the root link is welded to the world; otherwise it floats freely. A
            welded robot without a movable joint is scenery: static, like a static object.
        package_dirs: Folder of each package in mesh names of the form ``package://<name>/...``.
        position: Initial position of the root link, in m; permanent if the base is fixed.
        orientation: Initial orientation of the root link, quaternion x, y, z, w; permanent if the
            base is fixed.
        collisions: Collision shapes: ``"shapes"``, those of the file; ``"boxes"`` or
            ``"capsules"``, the same with each mesh replaced by its bounding box or capsule, which
            is many times faster; ``"none"``.
        self_collisions: Whether links that are not connected by a joint collide with each other.
        feet: Links that collide as a sphere around their origin instead of with their own shapes,
            and the sphere's radius, in m.
        friction: Coefficient of friction of all links; a contact uses the smaller of the two. None:
            as in an MJCF file, otherwise 1.
        restitution: Coefficient of restitution of all links; a contact uses the product of the two.
        torsional_friction: Friction torque of all links about the normal of a contact per normal
            force, in m; a contact uses the larger of the two. None: as in an MJCF file (condim 4
            and 6), otherwise 0.
        rolling_friction: Friction torque against rolling per normal force, in m, in the same form
            (condim 6).
        joints: Settings of joints, by their name in the file.
        couplings: Which joints move together, besides those that follow others; None: those of an
            MJCF file, otherwise none. It starts at positions that couplings and limits allow.
        wheels: Links that roll on the ground without slip.
        mass_factors: Scale factors for the mass and moments of inertia of links, by their name in
            the file; 1 for all others.

    Raises:
        UnknownOptionError: If there is no such choice of `collisions`.
        ConfigError: If another option has the wrong type or is out of range.
    """

    urdf: str | Path
    name: str = "robot"
    fixed_base: bool = True
    package_dirs: Mapping[str, str | Path] = field(default_factory=dict)
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    orientation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    collisions: Collisions = "shapes"
    self_collisions: bool = False
    feet: Mapping[str, float] = field(default_factory=dict)
    friction: float | None = None
    restitution: float = 0.0
    joints: Mapping[str, JointSettings] = field(default_factory=dict)
    mass_factors: Mapping[str, float] = field(default_factory=dict)
    root: str = ""
    torsional_friction: float | None = None
    rolling_friction: float | None = None
    couplings: Sequence[JointCoupling] | None = None
    wheels: Sequence[Wheel] = ()

    def __post_init__(self) -> None:
        checks.name("robot", self.name)
        where = f'Robot "{self.name}": '
        checks.store_declared(where, self)
        if not isinstance(self.urdf, (str, Path)):
            raise ConfigError(f"{where}urdf is {self.urdf!r} but must be a path.")
        if self.collisions not in get_args(Collisions):
            known = get_args(Collisions)
            raise UnknownOptionError(f"{where}collisions", [str(self.collisions)], known)
        position = checks.vector(f"{where}position", self.position, 3)
        object.__setattr__(self, "position", position)
        orientation = checks.unit_quaternion(f"{where}orientation", self.orientation)
        object.__setattr__(self, "orientation", orientation)
        for link, radius in self.feet.items():
            checks.positive(f'{where}feet["{link}"]', radius)
        for option in MATERIAL:
            if (value := getattr(self, option)) is not None:
                checks.not_negative(f"{where}{option}", value)
        if self.couplings is not None:
            couplings = checks.things(f"{where}couplings", self.couplings, JointCoupling)
            object.__setattr__(self, "couplings", couplings)
        object.__setattr__(self, "wheels", checks.things(f"{where}wheels", self.wheels, Wheel))
        joints = self.joints if isinstance(self.joints, Mapping) else None
        if joints is None or not all(isinstance(each, JointSettings) for each in joints.values()):
            raise ConfigError(
                f"{where}joints is {self.joints!r} but must be a mapping from names to "
                "JointSettings."
            )
        for link, factor in self.mass_factors.items():
            checks.positive(f'{where}mass_factors["{link}"]', factor)
