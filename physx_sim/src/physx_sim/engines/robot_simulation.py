"""Simulation of a world whose robots and objects an engine steps.

An engine implements `RobotEngine` for one robot, `Algorithms` for any state of a world, and the
abstract methods of `RobotSimulation` for stepping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from physx_core.errors import listed
from physx_core.typing import Records, Vector
from physx_sim import CONTACT, Hook, State, StepDerivatives, Wrench, finite_vector
from physx_sim.engines.attachments import Attachments
from physx_sim.engines.changing import ChangeableSimulation
from physx_sim.engines.checks import integer
from physx_sim.engines.models.parts import Parts, warn_once
from physx_sim.engines.simulation_core import NOTHING, Engine
from physx_sim.errors import SimulationError

_FASTEST = 1e8
"""Speed, in m/s or rad/s, above which a state counts as no longer finite."""
_NEARBY = 1e-4
"""Change of velocities, in m/s or rad/s, whose two signs are compared."""
_DEEP = 5e-3
"""Depth, in m, above which a contact in the first step from a state is reported."""
_BLOCK = 64
"""Physics steps between checks of the state."""


class RobotSimulation(ChangeableSimulation[Engine]):
    """A world whose robots and moving objects are each simulated by a `RobotEngine`."""

    def __init__(self, parts: Parts, robots: Sequence[Engine], lacks: Sequence[str]) -> None:
        """Put the robots at rest in their neutral configuration.

        Args:
            parts: Everything in the world.
            robots: One for each movable of the world.
            lacks: Features that this simulation lacks.
        """
        super().__init__(parts, robots, lacks)
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
            (self.parts.rolling, "wheels that roll without slip"),
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

    # State ----------------------------------------------------------------------------------

    def set_state(self, positions: Vector, velocities: Vector) -> None:
        """Set the state without resetting the time."""
        self._check_open()
        q = self._checks.positions(positions)
        self._write(q, self._checks.velocities("velocities", velocities))
        self.clear_warm_start()

    def _write(self, q: Vector, v: Vector) -> None:
        self._stepped, self._last = False, NOTHING
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

    def _checked_last(self, state: State) -> tuple[Vector, Records]:
        """Return what was measured in the last step before a snapshot."""
        if not len(state.accelerations):
            return NOTHING
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

    def close(self) -> None:
        """Free the world; further calls do nothing."""
        self._closed = True
        self._robots, self._only = (), None
        self._links, self._slices = [], []
        self._hooks.clear()
        if self._made_algorithms is not None:
            self._made_algorithms.close()
        self._made_algorithms = None
