"""Settings of a body that can change while a world runs."""

from __future__ import annotations

from dataclasses import dataclass

from physx_core import checks

FRICTIONS = ("friction", "torsional_friction", "rolling_friction")
"""Names of the settings that are coefficients of friction."""
_VECTORS = {
    "position": 3,
    "orientation": 4,
    "velocity": 3,
    "angular_velocity": 3,
    "surface_velocity": 3,
}


@dataclass(frozen=True, kw_only=True)
class BodySettings:
    """What `Simulation.set_body` changes; None: no change.

    The pose and the velocities are those of static objects: a platform or a door moves as they say,
    whatever it pushes. To move other bodies, use `Simulation.set_state`.

    Attributes:
        mass: Mass of a link or moving object, in kg; its moments of inertia change in proportion.
        friction: Coefficient of friction of all its shapes.
        torsional_friction: Friction torque of all its shapes about the normal of a contact per
            normal force, in m.
        rolling_friction: Their friction torque against rolling per normal force, in m.
        hidden: Whether an object, moving or static, is absent: it touches nothing, rays pass it,
            and it stays at rest where it is. It returns there, or where `Simulation.set_state` put
            it in the meantime.
        position: Position of a static object, in m.
        orientation: Its orientation: quaternion x, y, z, w.
        velocity: Velocity of its center in the world frame, in m/s.
        angular_velocity: Its angular velocity in the world frame, in rad/s.
        surface_velocity: Velocity at which the surface of a static object or of the ground moves
            along itself, like a conveyor belt, in the body's frame, in m/s.

    Raises:
        ConfigError: If a value is out of range.
    """

    mass: float | None = None
    friction: float | None = None
    hidden: bool | None = None
    position: tuple[float, ...] | None = None
    orientation: tuple[float, ...] | None = None
    velocity: tuple[float, ...] | None = None
    angular_velocity: tuple[float, ...] | None = None
    surface_velocity: tuple[float, ...] | None = None
    torsional_friction: float | None = None
    rolling_friction: float | None = None

    def __post_init__(self) -> None:
        checks.store_declared("BodySettings.", self)
        if self.mass is not None:
            checks.positive("BodySettings.mass", self.mass)
        for option in FRICTIONS:
            if (value := getattr(self, option)) is not None:
                checks.not_negative(f"BodySettings.{option}", value)
        for option, length in _VECTORS.items():
            given = getattr(self, option)
            if given is not None:
                found = checks.vector(f"BodySettings.{option}", given, length)
                if option == "orientation":
                    found = checks.unit_quaternion("BodySettings.orientation", found)
                object.__setattr__(self, option, found)
