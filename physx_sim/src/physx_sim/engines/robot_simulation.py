"""Simulation of a world whose robots and objects an engine steps.

An engine implements `RobotEngine` for one robot, `Algorithms` for any state of a world, and the
abstract methods of `RobotSimulation` for stepping.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from physx_core.errors import listed
from physx_core.rotations import cross, to_matrix
from physx_core.typing import Records, Vector
from physx_sim import (
    CONTACT,
    FEATURES,
    AppliedAttachment,
    Attachment,
    BodySettings,
    Camera,
    HeightField,
    Hook,
    Simulation,
    State,
    StepDerivatives,
    Weld,
    Wrench,
    copy_to,
    finite_rows,
    finite_vector,
)
from physx_sim.engines.algorithms import Algorithms
from physx_sim.engines.attachments import Attachments, Bond, filled, frames_of
from physx_sim.engines.changes import Changes, Scenery, motion_of
from physx_sim.engines.checks import LayoutChecks, integer
from physx_sim.engines.engine import RobotEngine
from physx_sim.engines.influences import Hooks, Wrenches
from physx_sim.engines.models.parts import Parts, layout_of, warn_once
from physx_sim.engines.models.reach import Reach
from physx_sim.engines.rays import Caster
from physx_sim.engines.reactions import Reactions
from physx_sim.errors import SimulationError

_FASTEST = 1e8
"""Speed, in m/s or rad/s, above which a state counts as no longer finite."""
_NOTHING = np.zeros(0), np.zeros(0, CONTACT)
"""What is measured before the first step."""
_DEEP = 5e-3
"""Depth, in m, above which a contact in the first step from a state is reported."""
_BLOCK = 64
"""Physics steps between checks of the state."""
_NEARBY = 1e-4
"""Change of velocities, in m/s or rad/s, whose two signs are compared."""


Engine = TypeVar("Engine", bound=RobotEngine)


class RobotSimulation(Simulation, Generic[Engine]):
    """A world whose robots and moving objects are each simulated by a `RobotEngine`."""

    lacks: ClassVar[frozenset[str]] = frozenset()
    """Features that the engine never supports."""
    caveats: ClassVar[Mapping[str, str]] = {}
    """What is limited in features that it has; both make the table in docs/engines.md."""

    def __init__(self, parts: Parts, robots: Sequence[Engine], lacks: Sequence[str]) -> None:
        """Put the robots at rest in their neutral configuration.

        Args:
            parts: Everything in the world.
            robots: One for each movable of the world.
            lacks: Features that this simulation lacks.
        """
        self.features = frozenset(FEATURES) - self.lacks - set(lacks)
        self.parts = parts
        self.period = parts.world.period
        self.layout = layout_of(parts)
        self._checks = LayoutChecks(self.layout)
        self._robots = tuple(robots)
        self._only = robots[0] if len(robots) == 1 else None
        self._joint_count = len(self.layout.joints)
        self._closed = self._stepped = self._stepping = False
        self._last: tuple[Vector, Records] = _NOTHING
        self._frame = 0
        places = self.layout.parts.values()
        self._slices = [
            (robot, place.positions, place.velocities)
            for robot, place in zip(robots, places, strict=True)
        ]
        self._joints = [place.joints for place in places]
        self._links = [(robot, link) for robot in robots for link in range(len(robot.model.links))]
        self._made_algorithms: Algorithms | None = None
        self._caster: Caster | None = None
        self._made_reactions: Reactions | None = None
        carried = [body for movable in parts.movables for body in movable.model.bodies]
        self._jointed = [place for place, body in enumerate(carried) if body.joint is not None]
        self._reaches: dict[int, Reach] = {}
        for robot in robots:
            robot.write(robot.neutral(), np.zeros(robot.nv))
        self._wrenches, self._hooks = Wrenches(self.period), Hooks()
        self._changes, self._scenery = Changes(parts, self.layout), Scenery.of(parts)
        self._movers: list[int] = []
        self._hidden: list[int] = []
        self._frozen: dict[int, tuple[Vector, Vector]] = {}
        self._set_command_limits()
        self._watch()
        commands = np.zeros(self._joint_count)
        commands[self._positioned] = self.positions()[self._positioned_q]
        self._hold(commands)
        self._attachments = Attachments(self._bind, self.unbind)
        for attachment in parts.attachments:
            self.attach(attachment)
        self.clear_warm_start()

    def _set_command_limits(self) -> None:
        layout = self.layout
        modes = np.array(layout.modes)
        most, least = layout.max_torque.copy(), -layout.max_torque
        for mode, high, low in (
            ("servo", layout.max_velocity, -layout.max_velocity),
            ("velocity", layout.max_velocity, -layout.max_velocity),
            ("position", layout.upper, layout.lower),
        ):
            most, least = np.where(modes == mode, high, most), np.where(modes == mode, low, least)
        self._least, self._most = least, most
        self._forces_only = bool((modes == "force").all())
        tame = min(most.min(initial=np.inf), -least.max(initial=-np.inf))
        # Square of the norm up to which no command needs clipping.
        self._tame = tame**2 if tame > 0 else -1.0
        self._positioned = np.flatnonzero(modes == "position")
        joints = [joint for movable in self.parts.movables for joint in movable.model.joints]
        gains = np.array([min(joint.gain, 1 / self.period) for joint in joints])
        self._gains = gains[self._positioned]
        places = np.array(list(layout.position_index.values()), np.intp)
        self._positioned_q = places[self._positioned]

    # Running --------------------------------------------------------------------------------

    @abstractmethod
    def advance(self, n: int) -> None:
        """Simulate n physics steps."""

    @abstractmethod
    def make_algorithms(self) -> Algorithms:
        """Return the algorithms for any state of the world; called on first use."""

    def clear_warm_start(self) -> None:
        """Clear what the engine keeps from earlier steps, so that only the state matters."""

    @property
    def frame(self) -> int:
        """Number of physics steps since the simulation was built."""
        self._check_open()
        return self._frame

    def set_torques(self, torques: Vector) -> None:
        """Hold torques, shape (joints,), in N m or N, clipped to the joints' limits.

        Raises:
            SimulationError: If the shape is wrong, a value is not finite, or a joint's mode is not
                ``"force"``.
        """
        if self._closed:
            self._check_open()
        if not self._forces_only:
            others = [
                name
                for name, mode in zip(self.layout.joints, self.layout.modes, strict=True)
                if mode != "force"
            ]
            raise SimulationError(
                f"set_torques: these joints are not driven by torques: {listed(others)}. "
                "Use set_commands."
            )
        self._hold(finite_vector("torques", torques, self._joint_count))

    def set_commands(self, commands: Vector) -> None:
        """Hold commands, shape (joints,), in each joint's mode, clipped to the limits."""
        if self._closed:
            self._check_open()
        self._hold(finite_vector("commands", commands, self._joint_count))

    def commands(self) -> Vector:
        """Return the held commands, clipped to the joints' limits, shape (joints,)."""
        if self._closed:
            self._check_open()
        return self._commands.copy()

    def _hold(self, commands: Vector) -> None:
        if commands.dot(commands) > self._tame:
            np.maximum(commands, self._least, out=commands)
            np.minimum(commands, self._most, out=commands)
        self._commands = commands
        if self._only is not None:
            self._only.hold(commands)
            return
        for robot, part in zip(self._robots, self._joints, strict=True):
            robot.hold(commands[part])

    def step(self, n: int = 1) -> None:
        """Simulate n physics steps under the held commands.

        Raises:
            SimulationError: If `n` is invalid, the state is no longer finite, or a hook calls
                `step`.
        """
        if self._closed:
            self._check_open()
        if type(n) is not int or n < 0:
            n = integer("n, the number of steps,", n, 0)
        if self._stepping:
            raise SimulationError("A hook must not call step, because step calls the hook.")
        if self._watched:
            self._step_watched(n)
            return
        while n > 0:
            block = n if n < _BLOCK else _BLOCK
            if not self._stepped:
                block = 1
            self.advance(block)
            n -= block
            self._frame += block
            self._check_finite()
            if not self._stepped:
                self._check_start()

    def step_with_derivatives(self, n: int = 1, *, compare_sides: bool = False) -> StepDerivatives:
        """Simulate n physics steps; return how the result depends on what was before.

        Raises:
            SimulationError: If `n` is invalid, the state is no longer finite, or one of the steps
                has no derivatives.
        """
        self._check_has("step_derivatives")
        n = integer("n, the number of steps,", n, 1)
        for acts, what in (
            (len(self._hooks), "hooks, which may change anything"),
            (len(self._wrenches), "wrenches"),
            (len(self._attachments), "attachments"),
            (len(self._positioned), 'joints with the mode "position"; "servo" has them'),
            (self._movers, "static bodies that move"),
            (self._frozen, "hidden objects"),
        ):
            if acts:
                raise SimulationError(f"A step has no derivatives while there are {what}.")
        sides = self._both_sides(n) if compare_sides else None
        self.step(1)
        found = self.derivatives_of_step()
        for _ in range(n - 1):
            self.step(1)
            found = self.derivatives_of_step().after(found)
        if sides is None:
            return found
        slower, faster = (side - self.velocities() for side in sides)
        change = max(float(abs(faster - slower).max(initial=0.0)), 1e-12)
        return replace(found, asymmetry=2 * float(abs(faster + slower).max(initial=0.0)) / change)

    def _both_sides(self, n: int) -> tuple[Vector, Vector]:
        """Return the velocities n steps after two opposite small changes of those now."""
        state = self.snapshot()
        change = _NEARBY * np.random.default_rng(0).uniform(-1.0, 1.0, self.layout.nv)
        found = []
        for velocities in (state.velocities - change, state.velocities + change):
            self.set_state(state.positions, velocities)
            self.step(n)
            found.append(self.velocities())
            self.restore(state)
        return found[0], found[1]

    def derivatives_of_step(self) -> StepDerivatives:
        """Return the derivatives of the last physics step; feature `step_derivatives`.

        Raises:
            SimulationError: If it has none; the message names the reason.
        """
        raise self._lacks("step_derivatives")

    def _step_watched(self, n: int) -> None:
        self._stepping = True
        try:
            while n > 0:
                self._hooks.call(self, self._frame)
                self._check_open()
                block = 1
                if len(self._wrenches) or len(self._positioned) or self._movers:
                    self._push()
                    self._steer()
                else:
                    block = min(n, _BLOCK, self._hooks.pause(self._frame))
                self.advance(block)
                self._carry_on()
                n -= block
                self._frame += block
                self._check_finite()
                if not self._stepped:
                    self._check_start()
        finally:
            self._stepping = False
            self._watch()
            if not self._closed and not len(self._wrenches):
                self._release()

    def _check_start(self) -> None:
        """Name bodies that are inside others when the first step from a state is made."""
        self._stepped = True
        if "contacts" not in self.features:
            return
        contacts = self.read_contacts()
        for first, second in contacts[["body_a", "body_b"]][contacts["depth"] > _DEEP].tolist():
            names = self.layout.names
            warn_once(
                f'"{names[first]}" started more than {1e3 * _DEEP:.0f} mm inside '
                f'"{names[second]}". Engines push it out slowly; let it start elsewhere.'
            )

    def _carry_on(self) -> None:
        """Move static bodies on, and leave hidden ones where they are."""
        for place in self._movers:
            self._scenery.advance(place, self.period)
            self._place(place)
        for place, native in self._frozen.items():
            self._robots[place].set_native(*native)

    def _place(self, static: int) -> None:
        scenery = self._scenery
        self.place_static(
            static, scenery.poses[static], scenery.velocities[static], scenery.surfaces[static]
        )

    def _push(self) -> None:
        """Apply the wrenches of this frame."""
        if not len(self._wrenches):
            return
        self._release()
        for wrench, force, torque in self._wrenches.at(self._frame):
            robot, link = self._links[self._checks.body(wrench.body)]
            point, local = np.array(wrench.point), wrench.frame == "body"
            robot.push(link, force, torque, point, local)

    def _release(self) -> None:
        for robot in self._robots:
            robot.release()

    def _steer(self) -> None:
        """Update the velocities of servos that track position commands."""
        at = self._positioned
        if not len(at):
            return
        commands, most = self._commands.copy(), self.layout.max_velocity[at]
        errors = commands[at] - self.positions()[self._positioned_q]
        commands[at] = np.clip(self._gains * errors, -most, most)
        for robot, part in zip(self._robots, self._joints, strict=True):
            robot.hold(commands[part])

    def _check_finite(self) -> None:
        for robot in self._robots:
            if not robot.speed() < _FASTEST:
                reasons = [f"In this file, {text}." for text in robot.model.warnings]
                advice = reasons or ["Use a smaller period or smaller torques."]
                raise SimulationError(
                    f"The state is no longer finite, or faster than {_FASTEST:g} rad/s or m/s, "
                    f'after frame {self._frame} ("{robot.movable.name}", {robot.model.path.name}). '
                    + " ".join(advice)
                )

    def _watch(self) -> None:
        """Note whether any work is needed between steps."""
        self._watched = bool(
            len(self._hooks)
            or len(self._wrenches)
            or len(self._positioned)
            or self._movers
            or self._frozen
        )

    def add_hook(self, hook: Hook, every: int = 1) -> None:
        """Call a function before the physics steps whose frame is a multiple of `every`."""
        self._check_open()
        self._hooks.add(hook, integer("every", every, 1))
        self._watch()

    def remove_hook(self, hook: Hook) -> None:
        """Remove a hook."""
        self._check_open()
        self._hooks.remove(hook)
        self._watch()

    def apply_wrench(self, wrench: Wrench) -> int:
        """Apply a wrench to a body from now on; return its number for `remove_wrench`."""
        self._check_open()
        self._check_wrench(wrench)
        number = self._wrenches.add(wrench, self._frame)
        self._watch()
        return number

    def _check_wrench(self, wrench: Wrench) -> None:
        if not isinstance(wrench, Wrench):
            raise SimulationError(f"{wrench!r} is not a Wrench.")
        body = self._checks.body(wrench.body)
        if body >= len(self._links) or not self._links[body][0].can_move(self._links[body][1]):
            raise SimulationError(f'"{wrench.body}" cannot move, so no wrench can act on it.')

    def remove_wrench(self, number: int) -> None:
        """Remove a wrench."""
        self._check_open()
        self._wrenches.remove(number)
        self._watch()
        if not len(self._wrenches):
            self._release()

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

    def change_gravity(self, gravity: tuple[float, ...]) -> None:
        """Change the gravity in the engine; feature `gravity`."""
        raise self._lacks("gravity")

    def set_body(self, name: str, settings: BodySettings) -> None:
        """Change a body from now on.

        Raises:
            SimulationError: If there is no body with that name, or it does not have what changes.
            FeatureNotSupportedError: If the engine lacks `changes` or `moving_statics`.
        """
        body = self._checked_body(name, settings)
        if settings.hidden and self._attachments.hold(name):
            raise SimulationError(f'"{name}" is attached; detach it before hiding it.')
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

    def change_parts(self, before: Parts) -> None:
        """Take over masses, friction, and ground of `parts`; feature `changes`.

        Args:
            before: The parts that the engine has; what did not change is the same object.
        """
        raise self._lacks("changes")

    def hide(self, bodies: Sequence[int]) -> None:
        """Let bodies, given as indices into `Layout.names`, touch nothing, and all others touch.

        Moving objects among them are left where they are after each block of steps. Feature
        `changes`.
        """
        raise self._lacks("changes")

    def place_static(self, static: int, pose: Vector, velocity: Vector, surface: Vector) -> None:
        """Place a static body, given by its index, for the next step; feature `moving_statics`.

        Args:
            static: Index into `Layout.statics`.
            pose: Position in m, quaternion x, y, z, w, shape (7,); must not be kept.
            velocity: Velocity in the world frame, in m/s, then rad/s, shape (6,); likewise.
            surface: Velocity of its surface along itself, in its frame, in m/s, shape (3,).
        """
        raise self._lacks("moving_statics")

    def attach(self, attachment: Attachment) -> int:
        """Hold two bodies together from now on; return the attachment's number for `detach`.

        Raises:
            SimulationError: If one of them is hidden, or neither can move.
        """
        self._check_has("attachments")
        self._check_attachment(attachment)
        for name in (attachment.body_a, attachment.body_b):
            if self._changes.of(name).hidden:
                raise SimulationError(f'"{name}" is hidden, so nothing can be attached to it.')
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

    def bind(self, number: int, bond: Bond) -> None:
        """Hold two bodies together until `unbind`; feature `attachments`."""
        raise self._lacks("attachments")

    def unbind(self, number: int) -> None:
        """Stop holding two bodies together, given the number from `bind`."""
        raise self._lacks("attachments")

    # State ----------------------------------------------------------------------------------

    def positions(self, out: Vector | None = None) -> Vector:
        """Return the positions, shape (nq,), copied to `out` if given."""
        if self._closed:
            self._check_open()
        only = self._only
        found = only.positions() if only else _join([robot.positions() for robot in self._robots])
        return found if out is None else copy_to(found, out)

    def velocities(self, out: Vector | None = None) -> Vector:
        """Return the velocities, shape (nv,), copied to `out` if given."""
        if self._closed:
            self._check_open()
        only = self._only
        found = only.velocities() if only else _join([each.velocities() for each in self._robots])
        return found if out is None else copy_to(found, out)

    def accelerations(self) -> Vector:
        """Return the velocity change in the last step divided by the period, shape (nv,)."""
        if self._closed:
            self._check_open()
        if not self._stepped:
            found = self._last[0]
            return found.copy() if len(found) else np.zeros(self.layout.nv)
        only = self._only
        if only and not self._frozen:
            return only.accelerations()
        found = _join([robot.accelerations() for robot in self._robots])
        for place in self._frozen:
            found[self._slices[place][2]] = 0.0
        return found

    def set_state(self, positions: Vector, velocities: Vector) -> None:
        """Set the state without resetting the time."""
        self._check_open()
        q = self._checks.positions(positions)
        self._write(q, self._checks.velocities("velocities", velocities))
        self.clear_warm_start()

    def _write(self, q: Vector, v: Vector) -> None:
        self._stepped, self._last = False, _NOTHING
        for robot, part, speed in self._slices:
            robot.write(q[part], v[speed])
        for place in self._frozen:
            self._frozen[place] = self._at_rest(place)

    def snapshot(self) -> State:
        """Return everything that `restore` needs to continue exactly from here.

        The engine's warm start is cleared, so that this simulation continues alike.
        """
        self._check_open()
        last = self._last
        if self._stepped:
            last = self.accelerations().copy(), self.read_contacts()
        self.clear_warm_start()
        changes = self._changes
        return State(
            self.positions(),
            self.velocities(),
            self._commands.copy(),
            self._frame,
            self._wrenches.snapshot(),
            self.engine,
            tuple(values for robot in self._robots for values in robot.native()),
            self._attachments.snapshot(),
            *last,
            self.gravity,
            {name: changes.now(name, self._scenery) for name in sorted(changes.applied)},
            changes.ground,
        )

    def restore(self, state: State) -> None:
        """Return to a snapshot: exactly if it is this engine's, within rounding if another's.

        Raises:
            SimulationError: If it is not a snapshot, or one of a world with a different layout.
        """
        self._check_open()
        if not isinstance(state, State):
            raise SimulationError(f"restore needs the result of snapshot, not {state!r}.")
        commands = finite_vector("state.commands", state.commands, len(self.layout.joints))
        q = self._checks.positions(state.positions)
        v = finite_vector("state.velocities", state.velocities, self.layout.nv)
        frame = integer("state.frame", state.frame, 0)
        for applied in state.wrenches:
            self._check_wrench(applied.wrench)
        for each in state.attachments:
            self._check_applied(each)
        last = self._checked_last(state)
        gravity = self.gravity
        if len(state.gravity):
            gravity = finite_vector("state.gravity", state.gravity, 3)
        native = self._checked_native(state) if state.engine == self.engine else []
        bodies = {self._checked_body(name, each): each for name, each in state.bodies.items()}
        if state.ground is not None:
            self._changes.check_ground(state.ground)
        if tuple(gravity.tolist()) != self.parts.world.gravity:  # not all engines can change it
            self.set_gravity(gravity.tolist())
        self._restore_changes(state, bodies)
        self._write(q, v)
        for robot, pair in zip(self._robots, native, strict=False):
            robot.set_native(*pair)
        self._frozen = {place: self._robots[place].native() for place in self._frozen}
        self._attachments.restore(state.attachments)
        self.clear_warm_start()
        self._release()
        self._wrenches.restore(state.wrenches)
        self._watch()
        self._hold(commands)
        self._frame, self._last = frame, last

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

    def _check_applied(self, applied: AppliedAttachment) -> None:
        self._check_has("attachments")
        self._check_attachment(applied.attachment)
        if filled(applied.attachment, (np.eye(4), np.eye(4))) != applied.attachment:
            raise SimulationError(
                f"The snapshot does not say where {applied.attachment} holds its bodies."
            )

    def _checked_last(self, state: State) -> tuple[Vector, Records]:
        """Return what was measured in the last step before a snapshot."""
        if not len(state.accelerations):
            return _NOTHING
        found = finite_vector("state.accelerations", state.accelerations, self.layout.nv)
        contacts = np.array(state.contacts)
        if contacts.dtype != CONTACT or contacts.ndim != 1:
            raise SimulationError("state.contacts are not CONTACT records.")
        bodies = np.stack([contacts["body_a"], contacts["body_b"]])
        if ((bodies < 0) | (bodies >= len(self.layout.names))).any():
            raise SimulationError("state.contacts name bodies that are not in this world.")
        return found, contacts

    def _checked_native(self, state: State) -> list[tuple[Vector, Vector]]:
        wanted = [len(values) for robot in self._robots for values in robot.native()]
        if not isinstance(state.native, tuple) or len(state.native) != len(wanted):
            raise SimulationError("The snapshot is of another world: its native state differs.")
        given = [
            finite_vector("state.native", values, length)
            for values, length in zip(state.native, wanted, strict=True)
        ]
        return list(zip(given[::2], given[1::2], strict=True))

    # Measurements ---------------------------------------------------------------------------

    def contacts(self) -> Records:
        """Return the contacts of the last physics step as a new array of `CONTACT` records."""
        self._check_has("contacts")
        return self.read_contacts() if self._stepped else self._last[1].copy()

    def raycast(self, begins: Vector, ends: Vector, ignored: Sequence[str] = ()) -> Records:
        """Return the first hit of each ray as an array of `RAY_HIT` records.

        Raises:
            SimulationError: If there are not as many start as end points, or a name is unknown.
        """
        self._check_has("raycast")
        first, last = finite_rows("begins", begins, 3), finite_rows("ends", ends, 3)
        if len(first) != len(last):
            raise SimulationError(
                f"There are {len(first)} ray start points but {len(last)} end points."
            )
        if self._caster is None:
            self._caster = Caster(self.parts)
        poses = self._algorithms.body_poses(self.positions(), range(len(self.layout.bodies)))
        poses = np.concatenate([poses, self._scenery.poses])
        passed = [*self._checks.bodies(ignored), *self._hidden]
        return self._caster.cast(first, last, poses, passed)

    def take_images(self, camera: Camera) -> dict[str, Vector]:
        """Return the images of a camera by their names, in the present state."""
        self._check_has("cameras")
        carriers = [camera.body] if camera.body else []
        passed = [*self._checks.bodies([*carriers, *camera.ignored]), *self._hidden]
        position, turn = np.array(camera.position), to_matrix(camera.rotation)
        for x, y, z, *orientation in self.body_poses(carriers).tolist():
            whole = to_matrix(orientation)
            position, turn = whole @ position + (x, y, z), whole @ turn
        return self.draw(camera, position, turn, passed)

    def draw(
        self, camera: Camera, position: Vector, turn: Vector, passed: Sequence[int]
    ) -> dict[str, Vector]:
        """Return the images of a camera; called only if the engine has the feature ``cameras``.

        Args:
            camera: The camera.
            position: Its position in the world, shape (3,), in m.
            turn: Its axes in the world, as columns, shape (3, 3).
            passed: Bodies that it does not see, as indices into `Layout.names`.
        """
        raise self._lacks("cameras")

    def joint_wrenches(self) -> Vector:
        """Return the joint reactions in the last step, shape (joints, 6)."""
        return self._reactions(self._jointed)

    def link_wrenches(self, names: Sequence[str]) -> Vector:
        """Return the reactions of the joints that lead to links, shape (names, 6).

        Raises:
            SimulationError: If no joint leads to a link, or anything is attached.
        """
        self._check_has("joint_wrenches")
        places = self._checks.bodies(names)
        for name, place in zip(names, places, strict=True):
            if place >= len(self._links) or self._is_root(place):
                raise SimulationError(f'No joint leads to "{name}".')
        return self._reactions(places)

    def _is_root(self, body: int) -> bool:
        robot, link = self._links[body]
        return link == 0 and not robot.fixed_base

    def _reactions(self, links: Sequence[int]) -> Vector:
        self._check_has("joint_wrenches")
        if len(self._attachments):
            raise SimulationError(
                "Reactions of joints need the forces of all attachments, which are not known."
            )
        if self._made_reactions is None:
            self._made_reactions = Reactions(self.parts)
        return self._made_reactions.of(links, self.body_motions(), self._outer(self.positions()))

    def _outer(self, q: Vector) -> dict[int, list[float]]:
        """Return the external forces on bodies in the last step, and torques about origins."""
        found: dict[int, list[float]] = {}
        if not (self._stepped or len(self._last[0])):
            return found
        poses = self._algorithms.body_poses(q, range(len(self.layout.bodies)))
        contacts = self.contacts() if "contacts" in self.features else np.zeros(0, CONTACT)
        for first, second, (x, y, z), force, _, _, torque in contacts.tolist():
            for body, sign in ((first, 1.0), (second, -1.0)):
                if body < len(poses):
                    a, b, c = poses[body, :3].tolist()
                    acting = [sign * part for part in force]
                    _add(found, body, acting, cross(x - a, y - b, z - c, *acting))
                    _add(found, body, (0.0, 0.0, 0.0), [sign * part for part in torque])
        for wrench, force, torque in self._wrenches.before(self._frame):
            body = self._checks.body(wrench.body)
            turn = to_matrix(poses[body, 3:])
            if wrench.frame == "body":
                force, torque = turn @ force, turn @ torque
            arm = turn @ wrench.point
            _add(found, body, force, torque + cross(*arm.tolist(), *force.tolist()))
        return found

    @abstractmethod
    def read_contacts(self) -> Records:
        """Return the contacts of the last physics step."""

    # Bodies and dynamics of any state -------------------------------------------------------

    def body_poses(
        self, names: Sequence[str] | None = None, positions: Vector | None = None
    ) -> Vector:
        """Return the poses of bodies, shape (names, 7): x, y, z and quaternion x, y, z, w."""
        self._check_open()
        q = self.positions() if positions is None else self._checks.positions(positions)
        chosen = self._checks.bodies(names)
        found = self._algorithms.body_poses(q, chosen)
        return self._with_scenery(found, chosen) if self._changes.applied else found

    def _with_scenery(self, found: Vector, bodies: Sequence[int]) -> Vector:
        """Return poses or motions of bodies, with those of static bodies as they are now."""
        scenery = self._scenery
        for row, body in zip(found, bodies, strict=True):
            if (static := body - len(self._links)) >= 0:
                row[:7] = scenery.poses[static]
                row[7:13] = scenery.velocities[static, : len(row) - 7]
        return found

    def body_velocities(
        self,
        names: Sequence[str] | None = None,
        positions: Vector | None = None,
        velocities: Vector | None = None,
    ) -> Vector:
        """Return the velocities of body origins, shape (names, 6): linear, angular."""
        if positions is None and velocities is None:
            return self.body_motions(names)[:, 7:13].copy()
        self._check_open()
        q = self.positions() if positions is None else self._checks.positions(positions)
        v = self.velocities()
        if velocities is not None:
            v = self._checks.velocities("velocities", velocities)
        return self._motions(q, v, np.zeros(self.layout.nv), names)[:, 7:13].copy()

    def _motions(self, q: Vector, v: Vector, a: Vector, names: Sequence[str] | None) -> Vector:
        chosen = self._checks.bodies(names)
        found = self._algorithms.motions(q, v, a, chosen)
        return self._with_scenery(found, chosen) if self._changes.applied else found

    def body_accelerations(self, names: Sequence[str] | None = None) -> Vector:
        """Return the accelerations of body origins, shape (names, 6): linear, angular."""
        return self.body_motions(names)[:, 13:].copy()

    def body_motions(self, names: Sequence[str] | None = None) -> Vector:
        """Return the current poses, velocities, and accelerations of bodies, shape (names, 19)."""
        if self._closed:
            self._check_open()
        return self._motions(self.positions(), self.velocities(), self.accelerations(), names)

    def reach(self, name: str, direction: Vector, positions: Vector | None = None) -> float:
        """Return how far a robot's or object's collision shapes extend along a direction."""
        self._check_open()
        place, along = self._checks.part(name), finite_vector("direction", direction, 3)
        if place not in self._reaches:
            self._reaches[place] = Reach(self.parts.movables[place])
        bodies = self.layout.parts[name].bodies
        q = self.positions() if positions is None else self._checks.positions(positions)
        poses = self._algorithms.body_poses(q, range(bodies.start, bodies.stop))
        return self._reaches[place].along(along, poses)

    def forward_dynamics(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations, shape (nv,), caused by torques (nv,) in a state."""
        return self._algorithms.forward_dynamics(
            *self._checked_state(positions, velocities, torques=torques)
        )

    def inverse_dynamics(
        self, positions: Vector, velocities: Vector, accelerations: Vector
    ) -> Vector:
        """Return the torques, shape (nv,), that produce accelerations (nv,) in a state."""
        return self._algorithms.inverse_dynamics(
            *self._checked_state(positions, velocities, accelerations=accelerations)
        )

    def mass_matrix(self, positions: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""
        self._check_open()
        return self._algorithms.mass_matrix(self._checks.positions(positions))

    def jacobian(
        self, body: str, positions: Vector, point: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> Vector:
        """Return the Jacobian, shape (6, nv), of a point on a link or object."""
        self._check_open()
        place, at = self._checks.body(body), finite_vector("point", point, 3)
        return self._algorithms.jacobian(place, self._checks.positions(positions), at)

    def forward_dynamics_derivatives(
        self, positions: Vector, velocities: Vector, torques: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return derivatives of `forward_dynamics` w.r.t. positions, velocities, and torques."""
        self._check_has("derivatives")
        return self._algorithms.forward_dynamics_derivatives(
            *self._checked_state(positions, velocities, torques=torques)
        )

    def forward_dynamics_batch(
        self, positions: Vector, velocities: Vector, torques: Vector, *, processes: int = 1
    ) -> Vector:
        """Return `forward_dynamics` for many states, shape (n, nv)."""
        self._check_open()
        processes = integer("processes", processes, 1)
        q, v, tau = self._checks.rows(positions, velocities=velocities, torques=torques)
        return self._algorithms.forward_batch(q, v, tau, processes)

    def forward_dynamics_gradients_batch(
        self,
        positions: Vector,
        velocities: Vector,
        accelerations: Vector,
        weights: Vector,
        *,
        processes: int = 1,
    ) -> Vector:
        """Return gradients of weighted sums of `forward_dynamics`, shape (3, n, nv)."""
        self._check_has("derivatives")
        processes = integer("processes", processes, 1)
        q, v, a, w = self._checks.rows(
            positions, velocities=velocities, accelerations=accelerations, weights=weights
        )
        return self._algorithms.gradients_batch(q, v, a, w, processes)

    def _checked_state(
        self, positions: Any, velocities: Any, **third: Any
    ) -> tuple[Vector, Vector, Vector]:
        self._check_open()
        check = self._checks.velocities
        ((name, values),) = third.items()
        q = self._checks.positions(positions)
        return q, check("velocities", velocities), check(name, values)

    @property
    def _algorithms(self) -> Algorithms:
        if self._made_algorithms is None:
            self._check_open()
            self._made_algorithms = self.make_algorithms()
        return self._made_algorithms

    def _check_has(self, feature: str) -> None:
        self._check_open()
        if feature not in self.features:
            raise self._lacks(feature)

    def _check_open(self) -> None:
        if self._closed:
            raise SimulationError("The simulation is closed; build a new one.")

    def close(self) -> None:
        """Free the world; further calls do nothing."""
        self._closed = True
        self._robots, self._only = (), None
        self._links, self._slices = [], []
        self._hooks.clear()
        if self._made_algorithms is not None:
            self._made_algorithms.close()
        self._made_algorithms = None


def _join(parts: Sequence[Vector]) -> Vector:
    """Concatenate vectors."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _add(wrenches: dict[int, list[float]], body: int, force: Any, torque: Any) -> None:
    """Add a force and a torque on a body."""
    before = wrenches.get(body, (0.0,) * 6)
    wrenches[body] = [a + b for a, b in zip(before, (*force, *torque), strict=True)]
