"""What the simulations of all engines have in common: stepping, and what acts meanwhile.

An engine implements `RobotEngine` for one robot, and `RobotSimulation.advance` for its world.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from physx_core.errors import SimulationError, listed
from physx_core.rotations import cross, to_matrix
from physx_core.simulation import CONTACT, FEATURES, Hook, State, Wrench, finite_vector
from physx_core.typing import Records, Vector
from physx_dart.shared.checks import integer
from physx_dart.shared.engine import RobotEngine
from physx_dart.shared.influences import Hooks, Wrenches
from physx_dart.shared.parts import Parts
from physx_dart.shared.world_state import WorldState

_FASTEST = 1e8
"""Speed, in m/s or rad/s, beyond which a state counts as no longer finite."""
_BLOCK = 64
"""Physics steps between two checks of the state."""


class RobotSimulation(WorldState):
    """A world that is stepped."""

    lacks: ClassVar[frozenset[str]] = frozenset()
    """Features that the engine never has."""

    def __init__(self, parts: Parts, robots: Sequence[RobotEngine], lacks: Sequence[str]) -> None:
        """Keep the robots and put them at rest in their neutral configuration.

        Args:
            parts: All of the world.
            robots: Of each mover of the world.
            lacks: Features that this simulation does not have.
        """
        super().__init__(parts, robots)
        self.features = frozenset(FEATURES) - self.lacks - set(lacks)
        self._frame = 0
        self._stepping = False
        self._wrenches, self._hooks = Wrenches(self.period), Hooks()
        self._set_command_limits()
        self._watch()
        self._hold(self._neutral_commands())

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
        # Square of a length up to which no command needs to be cut.
        self._tame = tame**2 if tame > 0 else -1.0
        self._positioned = np.flatnonzero(modes == "position")

    def _neutral_commands(self) -> Vector:
        commands = np.zeros(len(self.layout.joints))
        for robot, part in zip(self._robots, self._joints, strict=True):
            at_rest = robot.neutral()[robot.nq - len(robot.model.joints) :]
            settings = [joint.settings.mode == "position" for joint in robot.model.joints]
            commands[part] = np.where(settings, at_rest, 0.0)
        return commands

    # Running --------------------------------------------------------------------------------

    @abstractmethod
    def advance(self, n: int) -> None:
        """Simulate n physics steps."""

    @property
    def frame(self) -> int:
        """Number of physics steps since the simulation was built."""
        self._check_open()
        return self._frame

    def set_torques(self, torques: Vector) -> None:
        """Hold torques, shape (joints,), in N m or N; the joints' limits cut them."""
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
        """Hold commands, shape (joints,), each as its joint's mode says; the limits cut them."""
        if self._closed:
            self._check_open()
        self._hold(finite_vector("commands", commands, self._joint_count))

    def commands(self) -> Vector:
        """Return the held commands as the joints' limits cut them, shape (joints,)."""
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
        """Simulate n physics steps under the held commands."""
        if self._closed:
            self._check_open()
        if type(n) is not int or n < 0:
            n = integer("n, the number of steps,", n, 0)
        if self._stepping:
            raise SimulationError("A hook cannot call step: it is called by it.")
        if self._watched:
            self._step_watched(n)
            return
        while n > 0:
            block = n if n < _BLOCK else _BLOCK
            self.advance(block)
            n -= block
            self._frame += block
            self._stepped = True
            self._check_finite()

    def _step_watched(self, n: int) -> None:
        self._stepping = True
        try:
            while n > 0:
                self._hooks.call(self, self._frame)
                self._check_open()
                block = 1
                if len(self._wrenches) or len(self._positioned):
                    self._push()
                    self._steer()
                else:
                    block = min(n, _BLOCK, self._hooks.pause(self._frame))
                self.advance(block)
                n -= block
                self._frame += block
                self._stepped = True
                self._check_finite()
        finally:
            self._stepping = False
            self._watch()
            if not self._closed and not len(self._wrenches):
                self._release()

    def _push(self) -> None:
        """Let the wrenches of this frame act."""
        if not len(self._wrenches):
            return
        self._release()
        for wrench, force, torque in self._wrenches.at(self._frame):
            robot, link = self._bodies[wrench.body]
            point, local = np.array(wrench.point), wrench.frame == "body"
            robot.push(link, force, torque, point, local)

    def _release(self) -> None:
        for robot in self._robots:
            robot.release()

    def _steer(self) -> None:
        """Give the servos of joints with a position command their velocities."""
        if not len(self._positioned):
            return
        commands = self._commands.copy()
        for robot, part in zip(self._robots, self._joints, strict=True):
            joints = robot.model.joints
            q = robot.positions()[robot.nq - len(joints) :]
            for i, joint in enumerate(joints):
                if joint.settings.mode == "position":
                    gain = min(joint.settings.gain, 1 / self.period)
                    speed = gain * (commands[part][i] - q[i])
                    commands[part.start + i] = np.clip(
                        speed, -joint.max_velocity, joint.max_velocity
                    )
            robot.hold(commands[part])

    def _check_finite(self) -> None:
        for robot in self._robots:
            if not robot.speed() < _FASTEST:
                raise SimulationError(
                    f"The state is no longer finite, or faster than {_FASTEST:g} rad/s or m/s, "
                    f'after frame {self._frame} ("{robot.mover.name}", {robot.model.path.name}). '
                    "Use a smaller period, or gentler torques."
                )

    def _watch(self) -> None:
        """Note whether anything acts between the steps."""
        self._watched = bool(len(self._hooks) or len(self._wrenches) or len(self._positioned))

    def add_hook(self, hook: Hook, every: int = 1) -> None:
        """Call a function before the physics steps whose frame is a multiple of `every`."""
        self._check_open()
        self._hooks.add(hook, integer("every", every, 1))
        self._watch()

    def remove_hook(self, hook: Hook) -> None:
        """Call a function no longer."""
        self._check_open()
        self._hooks.remove(hook)
        self._watch()

    def apply_wrench(self, wrench: Wrench) -> int:
        """Let a force act on a body from now on; return its number for `remove_wrench`."""
        self._check_open()
        self._check_wrench(wrench)
        number = self._wrenches.add(wrench, self._frame)
        self._watch()
        return number

    def _check_wrench(self, wrench: Wrench) -> None:
        if not isinstance(wrench, Wrench):
            raise SimulationError(f"{wrench!r} is no Wrench.")
        self._place(wrench.body)
        robot, link = self._bodies.get(wrench.body, (None, 0))
        if robot is None or not robot.can_move(link):
            raise SimulationError(f'"{wrench.body}" cannot move, so no wrench acts on it.')

    def remove_wrench(self, number: int) -> None:
        """End a wrench."""
        self._check_open()
        self._wrenches.remove(number)
        self._watch()
        if not len(self._wrenches):
            self._release()

    # State ----------------------------------------------------------------------------------

    def set_state(self, positions: Vector, velocities: Vector) -> None:
        """Put the world into a state; time goes on."""
        self._check_open()
        q = self._checked_positions(positions)
        self._write(q, finite_vector("velocities", velocities, self.layout.nv))

    def _write(self, q: Vector, v: Vector) -> None:
        self._stepped = False
        for robot, part, speed in zip(self._robots, self._q, self._v, strict=True):
            robot.write(q[part], v[speed])

    def snapshot(self) -> State:
        """Return everything that `restore` needs to go on exactly from here."""
        self._check_open()
        return State(
            self.positions(),
            self.velocities(),
            self._commands.copy(),
            self._frame,
            self._wrenches.snapshot(),
            self.engine,
            tuple(values for robot in self._robots for values in robot.native()),
        )

    def restore(self, state: State) -> None:
        """Go back to a snapshot: bit for bit to an own one, within rounding to another engine's."""
        self._check_open()
        if not isinstance(state, State):
            raise SimulationError(f"restore takes what snapshot returned, not {state!r}.")
        commands = finite_vector("state.commands", state.commands, len(self.layout.joints))
        q = self._checked_positions(state.positions)
        v = finite_vector("state.velocities", state.velocities, self.layout.nv)
        frame = integer("state.frame", state.frame, 0)
        for applied in state.wrenches:
            self._check_wrench(applied.wrench)
        native = self._checked_native(state) if state.engine == self.engine else []
        self._write(q, v)
        for robot, pair in zip(self._robots, native, strict=False):
            robot.set_native(*pair)
        self._release()
        self._wrenches.restore(state.wrenches)
        self._watch()
        self._hold(commands)
        self._frame = frame

    def _checked_native(self, state: State) -> list[tuple[Vector, Vector]]:
        wanted = [len(values) for robot in self._robots for values in robot.native()]
        if not isinstance(state.native, tuple) or len(state.native) != len(wanted):
            raise SimulationError("The snapshot is of another world: its native state differs.")
        given = [
            finite_vector("state.native", values, length)
            for values, length in zip(state.native, wanted, strict=True)
        ]
        return list(zip(given[::2], given[1::2], strict=True))

    def contacts(self) -> Records:
        """Return the contacts of the last physics step: an array of `CONTACT` records, a copy."""
        self._check_open()
        if "contacts" not in self.features:
            raise self._lacks("contacts")
        return self.touching() if self._stepped else np.zeros(0, CONTACT)

    def joint_wrenches(self) -> Vector:
        """Return what the joints carried in the last step, shape (joints, 6)."""
        self._check_open()
        q, v, a = self.positions(), self.velocities(), self.accelerations()
        return self._algorithms.joint_wrenches(q, v, a, self._outer(q))

    def _outer(self, q: Vector) -> dict[int, list[float]]:
        """Return what acted on bodies in the last step: force, torque about their origins."""
        found: dict[int, list[float]] = {}
        if not self._stepped:
            return found
        poses = self._algorithms.body_poses(q, range(len(self.layout.bodies)))
        contacts = self.contacts() if "contacts" in self.features else np.zeros(0, CONTACT)
        for first, second, (x, y, z), force, *_ in contacts.tolist():
            for body, sign in ((first, 1.0), (second, -1.0)):
                if body < len(poses):
                    a, b, c = poses[body, :3].tolist()
                    acting = [sign * part for part in force]
                    _add(found, body, acting, cross(x - a, y - b, z - c, *acting))
        for wrench, force, torque in self._wrenches.before(self._frame):
            body = self._places[wrench.body]
            turn = to_matrix(poses[body, 3:])
            if wrench.frame == "body":
                force, torque = turn @ force, turn @ torque
            arm = turn @ wrench.point
            _add(found, body, force, torque + cross(*arm.tolist(), *force.tolist()))
        return found

    @abstractmethod
    def touching(self) -> Records:
        """Return the contacts of the last physics step."""

    def close(self) -> None:
        """Free the world; calling it again does nothing."""
        self._closed = True
        self._robots, self._only = (), None
        self._bodies = {}
        self._hooks.clear()
        if self._made_batches is not None:
            self._made_batches.close()
        self._made_algorithms = self._made_batches = None


def _add(wrenches: dict[int, list[float]], body: int, force: Any, torque: Any) -> None:
    """Add a force and a torque to those of a body."""
    before = wrenches.get(body, (0.0,) * 6)
    wrenches[body] = [a + b for a, b in zip(before, (*force, *torque), strict=True)]
