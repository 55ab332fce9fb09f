"""Changes: settings of bodies and motions of static ones since a world was built."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from physx_core.rotations import from_rotation_vector, multiply
from physx_core.typing import Vector
from physx_sim import BodySettings, HeightField, Layout
from physx_sim.description.body_settings import FRICTIONS
from physx_sim.engines.models.parts import MovableBody, Parts, static_poses
from physx_sim.engines.models.shapes import CollisionShape
from physx_sim.errors import SimulationError

_MOTION = ("position", "orientation", "velocity", "angular_velocity")


def motion_of(settings: BodySettings) -> tuple[tuple[float, ...] | None, ...]:
    """Return what settings say about the motion of a static body and its surface."""
    return (*(getattr(settings, option) for option in _MOTION), settings.surface_velocity)


@dataclass(eq=False)
class Scenery:
    """Motions of the static bodies of a world.

    Attributes:
        poses: Pose of each: position in m and quaternion x, y, z, w, shape (statics, 7).
        velocities: Velocity of each in the world frame, linear in m/s and angular in rad/s, shape
            (statics, 6).
        surfaces: Velocity of each one's surface in its own frame, in m/s, shape (statics, 3).
    """

    poses: Vector
    velocities: Vector
    surfaces: Vector

    @classmethod
    def of(cls, parts: Parts) -> Scenery:
        """Return the static bodies of a world, at rest."""
        poses = static_poses(parts)
        return cls(poses, np.zeros((len(poses), 6)), np.zeros((len(poses), 3)))

    def change(self, place: int, settings: BodySettings) -> None:
        """Set the pose and velocities of a static body where they are given."""
        pose, velocity = self.poses[place], self.velocities[place]
        for part, value in (
            (pose[:3], settings.position),
            (pose[3:], settings.orientation),
            (velocity[:3], settings.velocity),
            (velocity[3:], settings.angular_velocity),
            (self.surfaces[place], settings.surface_velocity),
        ):
            if value is not None:
                part[:] = value

    def differing(self, other: Scenery) -> list[int]:
        """Return the static bodies that move otherwise elsewhere."""
        mine, others = (
            np.concatenate([each.poses, each.velocities, each.surfaces], axis=1)
            for each in (self, other)
        )
        return [place for place, row in enumerate(mine) if (row != others[place]).any()]

    def moving(self) -> list[int]:
        """Return the static bodies that move, or whose surfaces do."""
        moves = self.velocities.any(axis=1) | self.surfaces.any(axis=1)
        return list(map(int, np.flatnonzero(moves)))

    def advance(self, place: int, period: float) -> None:
        """Move a static body for a time, in s."""
        if not self.velocities[place].any():
            return
        pose, velocity = self.poses[place], self.velocities[place]
        pose[:3] += period * velocity[:3]
        turn = from_rotation_vector(*(period * velocity[3:]).tolist())
        turned = np.array(multiply(turn, pose[3:].tolist()))
        turned *= np.copysign(1 / np.linalg.norm(turned), turned[3])
        pose[3:] = turned


class Changes:
    """Settings of bodies that differ from the world's description.

    Args:
        described: Everything in the world, as described.
        layout: Names in its state.

    Attributes:
        applied: What was changed, by the names of bodies.
        ground: The ground that replaces the described one, if any.
    """

    def __init__(self, described: Parts, layout: Layout) -> None:
        self._described, self._layout = described, layout
        self._objects = {m.name for m in described.movables if m.is_object}
        self._statics = [static.name for static in described.statics]
        self._links = [
            (place, link)
            for place, movable in enumerate(described.movables)
            for link in range(len(movable.model.links))
        ]
        self.applied: dict[str, BodySettings] = {}
        self.ground: HeightField | None = None

    def check(self, name: str, settings: BodySettings) -> None:
        """Check that a body has what settings change."""
        if not isinstance(settings, BodySettings):
            raise SimulationError(f"{settings!r} is not a BodySettings.")
        static, place = name in self._statics, self._layout.names.index(name)
        ground = static and not isinstance(self._what(name), CollisionShape)
        if settings.mass is not None:
            if static:
                raise SimulationError(f'"{name}" is static, so its mass has no effect.')
            movable, link = self._links[place]
            if not self._described.movables[movable].model.bodies[link].mass > 0:
                raise SimulationError(
                    f'"{name}" has no mass in its file, so its moments of inertia cannot change in '
                    "proportion."
                )
        if settings.hidden is not None and (ground or not (static or name in self._objects)):
            raise SimulationError(f'"{name}" is not an object, so it cannot be hidden.')
        if any(getattr(settings, option) is not None for option in _MOTION) and (
            ground or not static
        ):
            advice = "add a static object" if ground else "use set_state"
            raise SimulationError(f'"{name}" is not a static object; to move it, {advice}.')
        if settings.surface_velocity is not None and not static:
            raise SimulationError(f'"{name}" is not static, so its surface cannot move along it.')

    def check_ground(self, field: HeightField) -> None:
        """Check that a height field can replace the ground."""
        if not isinstance(field, HeightField):
            raise SimulationError(f"{field!r} is not a HeightField.")
        before = self._described.world.ground
        if not isinstance(before, HeightField):
            raise SimulationError(
                "Only a height field can replace the ground, and only if the ground was one when "
                "the world was built."
            )
        if field.heights.shape != before.heights.shape:
            raise SimulationError(
                f"The ground was built with {before.heights.shape} heights, so it cannot get "
                f"{field.heights.shape}."
            )

    def of(self, name: str) -> BodySettings:
        """Return what was changed about a body; of a static object, the pose of that time."""
        return self.applied.get(name, BodySettings())

    def now(self, name: str, scenery: Scenery) -> BodySettings:
        """Return what was changed about a body, with the current pose of a static object."""
        settings = self.of(name)
        if all(getattr(settings, option) is None for option in _MOTION):
            return settings
        pose = tuple(scenery.poses[self._statics.index(name)].tolist())
        return replace(settings, position=pose[:3], orientation=pose[3:])

    def merge(self, name: str, settings: BodySettings) -> None:
        """Change what settings give, and keep the rest."""
        given = {each.name: getattr(settings, each.name) for each in fields(settings)}
        given = {option: value for option, value in given.items() if value is not None}
        merged = replace(self.of(name), **given)
        self.applied[name] = merged

    def hidden(self) -> list[int]:
        """Return all hidden bodies, as indices into `Layout.names`."""
        names = (name for name, settings in self.applied.items() if settings.hidden)
        return sorted(self._layout.names.index(name) for name in names)

    def parts(self, now: Parts) -> Parts:
        """Return the parts of the world with all changes but motions.

        Args:
            now: The parts before, whose gravity stays.
        """
        described = self._described
        world = (
            described.world if self.ground is None else replace(described.world, ground=self.ground)
        )
        movables = [
            self._changed(movable, part.bodies.start)
            for movable, part in zip(described.movables, self._layout.parts.values(), strict=True)
        ]
        statics = []
        for static in described.statics:
            what = static.what if static.name != "ground" or self.ground is None else self.ground
            if frictions := _frictions(self.of(static.name)):
                what = replace(what, **frictions)
            statics.append(static if what is static.what else replace(static, what=what))
        world = replace(world, gravity=now.world.gravity)
        return replace(described, world=world, movables=tuple(movables), statics=tuple(statics))

    def _changed(self, movable: MovableBody, first: int) -> MovableBody:
        model, names = movable.model, self._layout.bodies[first:]
        changed = {link: self.of(name) for link, name in zip(model.links, names, strict=False)}
        bodies = tuple(
            body
            if (mass := changed[body.name].mass) is None
            else replace(body, mass=mass, inertia=body.inertia * (mass / body.mass))
            for body in model.bodies
        )
        rolling = {wheel.link for wheel in model.wheels}  # without friction, whatever it is
        shapes = tuple(
            replace(shape, **frictions)
            if shape.body not in rolling
            and (frictions := _frictions(changed.get(shape.body, changed[model.links[0]])))
            else shape
            for shape in model.shapes
        )
        if bodies == model.bodies and shapes == model.shapes:
            return movable
        return replace(movable, model=replace(model, bodies=bodies, shapes=shapes))

    def _what(self, name: str) -> object:
        return self._described.statics[self._statics.index(name)].what


def _frictions(settings: BodySettings) -> dict[str, Any]:
    """Return the coefficients of friction that settings give, by their names."""
    given = {option: getattr(settings, option) for option in FRICTIONS}
    return {option: value for option, value in given.items() if value is not None}
