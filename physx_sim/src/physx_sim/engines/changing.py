"""Changes of a running world: gravity, bodies, the ground, and what holds bodies together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from physx_core.rotations import to_matrix
from physx_core.typing import Vector
from physx_sim import (
    AppliedAttachment,
    Attachment,
    BodySettings,
    HeightField,
    State,
    Weld,
    finite_vector,
)
from physx_sim.engines.attachments import Bond, filled, frames_of
from physx_sim.engines.changes import Scenery, motion_of
from physx_sim.engines.models.parts import Parts
from physx_sim.engines.readings import ReadableSimulation
from physx_sim.engines.simulation_core import Engine
from physx_sim.errors import SimulationError


class ChangeableSimulation(ReadableSimulation[Engine]):
    """What can be changed in a world while it runs."""

    @property
    def gravity(self) -> Vector:
        """Acceleration of free fall in the world frame, in m/s², shape (3,); a copy."""
        self._check_open()
        return np.array(self.parts.world.gravity)

    def set_gravity(self, gravity: Sequence[float]) -> None:
        """Change the acceleration of free fall from now on.

        Raises:
            SimulationError: If it is not three finite numbers.
        """
        self._check_has("gravity")
        wanted = tuple(finite_vector("gravity", gravity, 3).tolist())
        if wanted == self.parts.world.gravity:
            return
        world = replace(self.parts.world, gravity=wanted)
        self._change_parts(replace(self.parts, world=world))
        self.change_gravity(wanted)

    def _change_parts(self, parts: Parts) -> None:
        """Forget what was made from the parts of the world."""
        self.parts = parts
        if self._made_algorithms is not None:
            self._made_algorithms.close()
        self._made_algorithms = self._made_reactions = self._caster = None

    def set_body(self, name: str, settings: BodySettings) -> None:
        """Change a body from now on.

        Raises:
            SimulationError: If there is no body with that name, it does not have what changes, or
                it is attached and would be hidden or moved.
            FeatureNotSupportedError: If the engine lacks `changes` or `moving_statics`.
        """
        body = self._checked_body(name, settings)
        moves = any(value is not None for value in motion_of(settings)[:-1])
        if (settings.hidden or moves) and self._attachments.hold(name):
            how = "hiding" if settings.hidden else "moving"
            raise SimulationError(f'"{name}" is attached; detach it before {how} it.')
        self._changes.merge(name, settings)
        self._move_static(body, settings)
        self._apply_changes()

    def body_settings(self, name: str) -> BodySettings:
        """Return what `set_body` changed about a body.

        Raises:
            SimulationError: If there is no body with that name.
        """
        self._check_has("changes")
        self._checks.body(name)
        return self._changes.now(name, self._scenery)

    def set_ground(self, field: HeightField) -> None:
        """Replace a height field by another one.

        Raises:
            SimulationError: If it is no height field, or the ground is none or has others.
        """
        self._check_has("changes")
        self._changes.check_ground(field)
        self._changes.ground = field
        self._apply_changes()

    def _checked_body(self, name: str, settings: BodySettings) -> int:
        self._check_has("changes")
        body = self._checks.body(name)
        self._changes.check(name, settings)
        if any(value is not None for value in motion_of(settings)):
            self._check_has("moving_statics")
        if settings.torsional_friction is not None or settings.rolling_friction is not None:
            self._check_has("torsional_friction")
        return body

    def _move_static(self, body: int, settings: BodySettings) -> None:
        """Set the pose and the velocities of a static body where they are given."""
        if all(value is None for value in motion_of(settings)):
            return
        static = body - len(self._links)
        self._scenery.change(static, settings)
        self._place(static)

    def _place(self, static: int) -> None:
        scenery = self._scenery
        self.place_static(
            static, scenery.poses[static], scenery.velocities[static], scenery.surfaces[static]
        )

    def _apply_changes(self) -> None:
        """Give the engine what differs between its parts and the changed ones."""
        before, hidden = self.parts, self._changes.hidden()
        self._movers = self._scenery.moving()
        parts = self._changes.parts(before)
        if parts.movables != before.movables or parts.statics != before.statics:
            self._change_parts(parts)
            self.change_parts(before)
        if hidden != self._hidden:
            self._hidden, frozen = hidden, {}
            for place, part in enumerate(self.layout.parts.values()):
                if part.bodies.start in hidden:
                    frozen[place] = self._frozen.get(place) or self._at_rest(place)
            self._frozen = frozen
            self.hide(hidden)
        self._watch()

    def _at_rest(self, place: int) -> tuple[Vector, Vector]:
        """Stop an object; return its native state."""
        robot = self._robots[place]
        robot.write(robot.positions(), np.zeros(robot.nv))
        return robot.native()

    def _restore_changes(self, state: State, bodies: Mapping[int, BodySettings]) -> None:
        changes, scenery = self._changes, Scenery.of(self.parts)
        if not (changes.applied or changes.ground or bodies or state.ground):
            return
        changes.applied, changes.ground = dict(state.bodies), state.ground
        before, self._scenery = self._scenery, scenery
        for body, settings in bodies.items():
            self._move_static(body, settings)
        for static in before.differing(scenery):
            self._place(static)
        self._apply_changes()

    def attach(self, attachment: Attachment) -> int:
        """Hold two bodies together from now on; return the attachment's number for `detach`.

        Raises:
            SimulationError: If one of them is hidden or is a static body that moves, or neither can
                move.
        """
        self._check_has("attachments")
        self._check_attachment(attachment)
        velocities = zip(self.layout.statics, self._scenery.velocities, strict=True)
        moving = [name for name, velocity in velocities if velocity.any()]
        for name in (attachment.body_a, attachment.body_b):
            if self._changes.of(name).hidden:
                raise SimulationError(f'"{name}" is hidden, so nothing can be attached to it.')
            if name in moving:
                raise SimulationError(f'"{name}" moves; stop it before attaching anything to it.')
        poses = [self._pose_of(name) for name in (attachment.body_a, attachment.body_b)]
        return self._attachments.add(filled(attachment, poses))

    def detach(self, number: int) -> None:
        """End an attachment."""
        self._check_open()
        self._attachments.remove(number)

    def _check_attachment(self, attachment: Attachment) -> None:
        if not isinstance(attachment, Attachment):
            raise SimulationError(f"{attachment!r} is not a Weld or Connect.")
        if not any(self._moves(name) for name in (attachment.body_a, attachment.body_b)):
            other = attachment.body_b or "the world"
            raise SimulationError(
                f'Neither "{attachment.body_a}" nor "{other}" can move, so nothing holds them.'
            )

    def _moves(self, name: str) -> bool:
        body = self._checks.body(name) if name else len(self._links)
        return body < len(self._links) and self._links[body][0].can_move(self._links[body][1])

    def _pose_of(self, name: str) -> Vector:
        """Return the pose of a body as a homogeneous matrix; no name: of the world."""
        found = np.eye(4)
        if name:
            pose = self.body_poses([name])[0]
            found[:3, :3], found[:3, 3] = to_matrix(pose[3:]), pose[:3]
        return found

    def _bind(self, number: int, attachment: Attachment) -> None:
        bodies, frames = [], list(frames_of(attachment))
        for side, name in enumerate((attachment.body_a, attachment.body_b)):
            moves = self._moves(name)
            bodies.append(self._checks.body(name) if moves else -1)
            if not moves:
                frames[side] = self._pose_of(name) @ frames[side]
        first, second = bodies
        self.bind(
            number, Bond((first, second), (frames[0], frames[1]), isinstance(attachment, Weld))
        )

    def _check_applied(self, applied: AppliedAttachment) -> None:
        self._check_has("attachments")
        self._check_attachment(applied.attachment)
        if filled(applied.attachment, (np.eye(4), np.eye(4))) != applied.attachment:
            raise SimulationError(
                f"The snapshot does not say where {applied.attachment} holds its bodies."
            )
