"""What the simulations of all engines have in common: robots side by side in one state.

An engine implements `RobotEngine` for one robot and `RobotSimulation.advance` for its world.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from physx_core.errors import ModelError, SimulationError, listed, nearest
from physx_core.interfaces.backend import Layout, Simulation, State, Vector
from physx_core.world import World
from physx_dart.urdf import Joint, RobotModel, read_robot

_FASTEST = 1e8
"""Speed, in m/s or rad/s, beyond which a state counts as no longer finite."""


class RobotEngine(ABC):
    """One robot in an engine. All vectors are in the convention of `physx_core`'s backends.

    Attributes:
        model: What the robot's file says.
        fixed_base: Whether the root link is welded to the world.
        nq: Length of its positions.
        nv: Length of its velocities.
    """

    def __init__(self, model: RobotModel, fixed_base: bool) -> None:
        self.model = model
        self.fixed_base = fixed_base
        self.nq = len(model.joints) + (0 if fixed_base else 7)
        self.nv = len(model.joints) + (0 if fixed_base else 6)
        self.damping = np.zeros(self.nv)
        self.friction = np.zeros(self.nv)
        moving = slice(self.nv - len(model.joints), self.nv)
        self.damping[moving] = [joint.damping for joint in model.joints]
        self.friction[moving] = [joint.friction for joint in model.joints]

    def neutral(self) -> Vector:
        """Return the positions at rest: 0, or the limit nearest to 0; base at the origin."""
        base = [] if self.fixed_base else [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        return np.array([*base, *(max(j.lower, min(0.0, j.upper)) for j in self.model.joints)])

    def resistance(self, velocities: Vector) -> Vector:
        """Return the torques of damping and Coulomb friction against a motion, shape (nv,)."""
        return self.damping * velocities + self.friction * np.sign(velocities)

    @abstractmethod
    def hold(self, torques: Vector) -> None:
        """Hold joint torques, shape (joints,), that are within their limits."""

    @abstractmethod
    def positions(self) -> Vector:
        """Return the present positions, shape (nq,), in a vector of its own."""

    @abstractmethod
    def velocities(self) -> Vector:
        """Return the present velocities, shape (nv,), in a vector of its own."""

    @abstractmethod
    def write(self, positions: Vector, velocities: Vector) -> None:
        """Set the state."""

    @abstractmethod
    def native(self) -> Any:
        """Return the state exactly as the engine has it, copied."""

    @abstractmethod
    def set_native(self, native: Any) -> None:
        """Set the state to what `native` returned."""

    @abstractmethod
    def speed(self) -> float:
        """Return the square of the velocities' length; NaN or inf where the state is broken."""

    @abstractmethod
    def poses(self, positions: Vector) -> Vector:
        """Return the poses of all links in positions, shape (links, 7)."""

    @abstractmethod
    def forward(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations that torques cause, resistance included."""

    @abstractmethod
    def inverse(self, positions: Vector, velocities: Vector, accelerations: Vector) -> Vector:
        """Return the torques that cause accelerations, resistance included."""


@dataclass(frozen=True)
class EngineState(State):
    """A snapshot that also holds each robot's state as its engine has it.

    Attributes:
        engine: Name of the simulation's class.
        native: One entry for each robot.
    """

    engine: str
    native: tuple[Any, ...]


class RobotSimulation(Simulation):
    """Robots of a world, each in a `RobotEngine`, as one state."""

    def __init__(self, world: World, robots: Sequence[RobotEngine]) -> None:
        """Keep the robots and put them at rest in their neutral configuration."""
        self.period = world.period
        self.layout = layout_of([robot.name for robot in world.robots], robots)
        self.features = frozenset(
            {"forward_dynamics", "inverse_dynamics", "limits", "exact_restore", "joint_friction"}
        )
        self._robots = tuple(robots)
        self._frame = 0
        self._closed = False
        self._q, self._v, self._joints = _slices(robots)
        self._places = {name: i for i, name in enumerate(self.layout.bodies)}
        self._torques = np.zeros(len(self.layout.joints))
        for robot in robots:
            robot.write(robot.neutral(), np.zeros(robot.nv))

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
        self._check_open()
        given = self._vector("torques", torques, len(self.layout.joints))
        limit = self.layout.max_torque
        self._hold(np.minimum(np.maximum(given, -limit), limit))

    def step(self, n: int = 1) -> None:
        """Simulate n physics steps under the held torques."""
        self._check_open()
        if n < 0:
            raise SimulationError(f"step({n}): the number of steps cannot be negative.")
        self.advance(n)
        self._frame += n
        with np.errstate(over="ignore"):
            speeds = [robot.speed() for robot in self._robots]
        for robot, speed in zip(self._robots, speeds, strict=True):
            if not speed < _FASTEST**2:
                raise SimulationError(
                    f"The state is no longer finite, or faster than {_FASTEST:g} rad/s or m/s, "
                    f"after frame {self._frame} ({robot.model.path.name}). Use a smaller period, "
                    "or gentler torques."
                )

    def positions(self, out: Vector | None = None) -> Vector:
        """Return the positions, shape (nq,), written into `out` if it is given."""
        self._check_open()
        return _joined([robot.positions() for robot in self._robots], out)

    def velocities(self, out: Vector | None = None) -> Vector:
        """Return the velocities, shape (nv,), written into `out` if it is given."""
        self._check_open()
        return _joined([robot.velocities() for robot in self._robots], out)

    def set_state(self, positions: Vector, velocities: Vector) -> None:
        """Put the world into a state; time goes on."""
        self._check_open()
        q = self._checked_positions(positions)
        v = self._vector("velocities", velocities, self.layout.nv)
        for robot, part, speed in zip(self._robots, self._q, self._v, strict=True):
            robot.write(q[part], v[speed])

    def snapshot(self) -> State:
        """Return everything that `restore` needs to go on exactly from here."""
        return EngineState(
            self.positions(),
            self.velocities(),
            self._torques.copy(),
            self._frame,
            engine=type(self).__name__,
            native=tuple(robot.native() for robot in self._robots),
        )

    def restore(self, state: State) -> None:
        """Go back to a snapshot: bit for bit to an own one, within rounding to another engine's."""
        self._check_open()
        torques = self._vector("state.torques", state.torques, len(self.layout.joints))
        self.set_state(state.positions, state.velocities)
        if isinstance(state, EngineState) and state.engine == type(self).__name__:
            for robot, native in zip(self._robots, state.native, strict=True):
                robot.set_native(native)
        self._hold(torques)
        self._frame = state.frame

    def body_poses(
        self, names: Sequence[str] | None = None, positions: Vector | None = None
    ) -> Vector:
        """Return the poses of links, shape (names, 7): x, y, z and quaternion x, y, z, w."""
        self._check_open()
        q = self.positions() if positions is None else self._checked_positions(positions)
        rows = _joined([r.poses(q[part]) for r, part in zip(self._robots, self._q, strict=True)])
        return rows if names is None else rows[[self._place(name) for name in names]]

    def forward_dynamics(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations, shape (nv,), that torques (nv,) cause in a state.

        The torques are not cut. Damping and Coulomb friction act against the velocities; a joint
        at rest has no Coulomb friction here. Position limits do not act.
        """
        return self._dynamics("torques", RobotEngine.forward, positions, velocities, torques)

    def inverse_dynamics(
        self, positions: Vector, velocities: Vector, accelerations: Vector
    ) -> Vector:
        """Return the torques, shape (nv,), that cause accelerations (nv,) in a state.

        The exact inverse of `forward_dynamics`.
        """
        name = "accelerations"
        return self._dynamics(name, RobotEngine.inverse, positions, velocities, accelerations)

    def close(self) -> None:
        """Free the world; calling it again does nothing."""
        self._closed = True
        self._robots = ()

    def _dynamics(
        self, name: str, method: Any, positions: Vector, velocities: Vector, third: Vector
    ) -> Vector:
        self._check_open()
        q = self._checked_positions(positions)
        v = self._vector("velocities", velocities, self.layout.nv)
        x = self._vector(name, third, self.layout.nv)
        parts = [
            getattr(robot, method.__name__)(q[part], v[speed], x[speed])
            for robot, part, speed in zip(self._robots, self._q, self._v, strict=True)
        ]
        return _joined(parts)

    def _hold(self, torques: Vector) -> None:
        self._torques = torques
        for robot, part in zip(self._robots, self._joints, strict=True):
            robot.hold(torques[part])

    def _place(self, name: str) -> int:
        place = self._places.get(name)
        if place is None:
            raise SimulationError(
                f'There is no link "{name}".{nearest(name, self._places)} '
                f"Links: {listed(self._places)}."
            )
        return place

    def _check_open(self) -> None:
        if self._closed:
            raise SimulationError("The simulation is closed; build a new one.")

    def _checked_positions(self, positions: ArrayLike) -> Vector:
        q = self._vector("positions", positions, self.layout.nq)
        for robot, part in zip(self._robots, self._q, strict=True):
            if not robot.fixed_base:
                length = float(np.linalg.norm(q[part][3:7]))
                if abs(length - 1.0) > 1e-3:
                    raise SimulationError(
                        f"A floating base's quaternion (positions 3 to 6 of {robot.model.path.name}"
                        f", in the order x, y, z, w) has length {length:g}, not 1."
                    )
        return q

    @staticmethod
    def _vector(name: str, given: ArrayLike, length: int) -> Vector:
        try:
            vector = np.array(given, np.float64)
        except (TypeError, ValueError) as error:
            raise SimulationError(f"{name} are no numbers: {error}.") from error
        if vector.shape != (length,):
            raise SimulationError(f"{name} have the shape {vector.shape} but need ({length},).")
        if not math.isfinite(vector.dot(vector)) and not np.isfinite(vector).all():
            raise SimulationError(f"{name} must be finite numbers, not {vector}.")
        return vector


def _joined(parts: Sequence[Vector], out: Vector | None = None) -> Vector:
    """Return the robots' parts as one, written into `out` if it is given."""
    whole = parts[0] if len(parts) == 1 else np.concatenate(parts)
    if out is None:
        return whole
    if out.shape != whole.shape:
        raise SimulationError(f"out has the shape {out.shape} but needs {whole.shape}.")
    out[:] = whole
    return out


def read_robots(world: World) -> list[RobotModel]:
    """Read the files of a world's robots.

    Raises:
        ModelError: A file cannot be read, or a robot has no joint and a fixed base.
    """
    models = [read_robot(robot) for robot in world.robots]
    for robot, model in zip(world.robots, models, strict=True):
        if robot.fixed_base and not model.joints:
            raise ModelError(
                f'Robot "{robot.name}", {model.path}: it has no joint that moves and a fixed base. '
                "Use fixed_base=False."
            )
    return models


def layout_of(names: Sequence[str], robots: Sequence[RobotEngine]) -> Layout:
    """Return names and places of several robots' joints and links in one state."""
    prefixes = [f"{name}/" if len(names) > 1 else "" for name in names]
    joints: list[Joint] = [joint for robot in robots for joint in robot.model.joints]
    joint_names: list[str] = []
    bodies: list[str] = []
    position_index: dict[str, int] = {}
    velocity_index: dict[str, int] = {}
    nq = nv = 0
    for prefix, robot in zip(prefixes, robots, strict=True):
        nq, nv = nq + robot.nq, nv + robot.nv
        count = len(robot.model.joints)
        bodies += [prefix + link for link in robot.model.links]
        for i, joint in enumerate(robot.model.joints):
            joint_names.append(prefix + joint.name)
            position_index[joint_names[-1]] = nq - count + i
            velocity_index[joint_names[-1]] = nv - count + i
    return Layout(
        joints=tuple(joint_names),
        bodies=tuple(bodies),
        position_index=position_index,
        velocity_index=velocity_index,
        nq=nq,
        nv=nv,
        lower=np.array([joint.lower for joint in joints]),
        upper=np.array([joint.upper for joint in joints]),
        max_velocity=np.array([joint.max_velocity for joint in joints]),
        max_torque=np.array([joint.max_torque for joint in joints]),
    )


def _slices(robots: Sequence[RobotEngine]) -> tuple[list[slice], ...]:
    counts = [(r.nq, r.nv, len(r.model.joints)) for r in robots]
    ends = np.cumsum(counts, axis=0)
    return tuple(
        [slice(int(end - row[k]), int(end)) for end, row in zip(ends[:, k], counts, strict=True)]
        for k in range(3)
    )
