"""A world with its engine, motors and sensors, and the buffers of what is measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from physx_core import checks, plugins
from physx_core.errors import ComponentNotFoundError, ConfigError
from physx_core.simulation import (
    Layout,
    Motor,
    Part,
    Sensor,
    Simulation,
    State,
    World,
    Wrench,
    with_rotors,
)
from physx_core.typing import Vector
from physx_gym.env.shared_arrays import SharedArrays
from physx_gym.simulator.equipment import Equipment, default_motors, default_sensors
from physx_gym.simulator.ground_placement import rise
from physx_gym.simulator.states import RobotState, StepperState


class Engine:
    """The engine at work, which can be built again from the description.

    Attributes:
        simulation: The engine's simulation.
        equipment: Motors and sensors on it.
        first: The state in which it was built.
        part: Place of the robot that acts.
    """

    def __init__(self, simulation: Simulation, equipment: Equipment, part: Part) -> None:
        self.simulation, self.equipment, self.part = simulation, equipment, part
        self.first: State = simulation.snapshot()


class EquippedWorld(SharedArrays):
    """A world with its engine, motors and sensors, which are built when they are first needed.

    Attributes:
        world: What is simulated; motors' rotors come on top.
        backend: Reference of the engine.
        control_period: Time between two commands, in s; None: a step of the environment.
        observe_period: Time between two observations, in s; None: as between two commands.
        builds: How often the engine was built.
    """

    _left_out: ClassVar[frozenset[str]] = frozenset({"_engine"})

    def __init__(
        self,
        world: World,
        *,
        backend: Any = "dart",
        robot: str | None = None,
        motors: Sequence[Motor] | None = None,
        sensors: Sequence[Sensor] | None = None,
        control_period: float | None = None,
        observe_period: float | None = None,
    ) -> None:
        """Describe a simulator.

        Args:
            world: What to simulate.
            backend: Reference of the engine, for example ``"dart"`` or ``"pinocchio"``.
            robot: Name of the robot that acts; None: the first.
            motors: None: one without imperfections on each of its joints that has a torque limit.
            sensors: None: an encoder on each motor's joint, and an inertial sensor on the root
                link of a robot whose base floats, both without imperfections.
            control_period: In s; None: once a step of the environment.
            observe_period: In s; None: as often as commands.

        Raises:
            ConfigError: An option cannot be.
            ComponentNotFoundError: The world has no robot of that name.
        """
        if not isinstance(world, World):
            raise ConfigError(f"A Simulator needs a World, not {world!r}.")
        names = [each.name for each in world.robots]
        if not names:
            raise ConfigError("The world has no robot that could act: World([Robot(...)], ...).")
        if robot is not None and robot not in names:
            raise ComponentNotFoundError("robot", str(robot), "The world", names)
        self.world, self.backend = world, backend
        self._robot_name = names[0] if robot is None else robot
        self._given_motors = _all_of("motors", Motor, motors)
        self._given_sensors = _all_of("sensors", Sensor, sensors)
        self._motors: tuple[Motor, ...] = self._given_motors or ()
        self._sensors: tuple[Sensor, ...] = self._given_sensors or ()
        self.control_period = positive_or_none("control_period", control_period)
        self.observe_period = positive_or_none("observe_period", observe_period)
        self.builds = 0
        self.is_simulation_running = np.zeros((), np.bool_)
        self.stepper_state = StepperState(dt=world.period)
        self._random = np.random.default_rng()
        self._forces: list[tuple[int, Wrench]] = []
        self._pending: list[tuple[int, Wrench]] = []
        self._moment = 1
        self._engine: Engine | None = None
        self._stale = False

    # The engine ------------------------------------------------------------------------------

    def _built(self) -> Engine:
        """Return the engine; it is built when it is first needed, or when options changed."""
        engine = self._engine
        if engine is None or self._stale:
            engine = self._build()
            self._allocate(engine)
        return engine

    def _build(self) -> Engine:
        """Build engine, motors and sensors."""
        self._drop()
        world = with_rotors(self.world, self._given_motors or ())
        simulation: Simulation = plugins.resolve("backend", self.backend).build(world)
        part = simulation.layout.parts[self._robot_name]
        if self._given_motors is None:
            self._motors = default_motors(simulation.layout, part)
        if self._given_sensors is None:
            self._sensors = default_sensors(simulation, part, self._motors)
        random = np.random.default_rng(0)  # biases are drawn again at each start
        equipment = Equipment(simulation, world, self._motors, self._sensors, random)
        self._sensors = equipment.sensor_list
        self._engine = Engine(simulation, equipment, part)
        self._stale = False
        self.builds += 1
        return self._engine

    def _drop(self) -> None:
        if self._engine is not None:
            self._engine.simulation.close()
            self._engine = None

    def _allocate(self, engine: Engine) -> None:
        """Make the buffers of what is measured: parts of one array."""
        layout, part = engine.simulation.layout, engine.part
        self._sizes = 1 + layout.nq, 1 + layout.nq + layout.nv
        self.values = np.zeros(self._sizes[1] + engine.equipment.size)
        self.positions = self.values[1 : self._sizes[0]]
        self.velocities = self.values[self._sizes[0] : self._sizes[1]]
        self._sensed, self._state = self.values[self._sizes[1] :], self.values[1 : self._sizes[1]]
        q, v = self.positions[part.positions], self.velocities[part.velocities]
        self.robot_state = RobotState(q, v, len(self._motors), self.stepper_state)
        self.robot_state.connect(engine.simulation, engine.equipment, part)
        self.measurements = self.views_of(self.values)
        np.copyto(self.positions, engine.first.positions)

    def views_of(self, values: Vector) -> dict[str, Any]:
        """Return measurements whose arrays are parts of an array of the form of `values`."""
        engine = self._built()
        q, v = values[1 : self._sizes[0]], values[self._sizes[0] : self._sizes[1]]
        agent = {"q": q[engine.part.positions], "v": v[engine.part.velocities]}
        found: dict[str, Any] = {"t": values[:1].reshape(()), "states": {"agent": agent}}
        sensed = engine.equipment.by_kind(values[self._sizes[1] :])
        if sensed:
            found["measurements"] = sensed
        return found

    @property
    def motors(self) -> tuple[Motor, ...]:
        """The motors of the robot that acts, in the order of its command."""
        self._know()
        return self._motors

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """The sensors, those of a kind side by side."""
        self._know()
        return self._sensors

    @property
    def sensed(self) -> dict[str, Vector]:
        """What the sensors of each kind measured last, shape (values, sensors)."""
        self.prepare()
        found: dict[str, Vector] = self.measurements.get("measurements", {})
        return found

    @property
    def simulation(self) -> Simulation:
        """The engine's simulation."""
        return self._built().simulation

    @property
    def layout(self) -> Layout:
        """Names and places in the state of the whole world."""
        return self._built().simulation.layout

    @property
    def robot(self) -> Part:
        """Place of the robot that acts."""
        return self._built().part

    @property
    def engine(self) -> str:
        """Name of the engine."""
        return self._built().simulation.engine

    @property
    def period(self) -> float:
        """Time of a physics step, in s."""
        return self.world.period

    def _know(self) -> None:
        """Build the engine, if it was never built: it alone knows the robot's joints."""
        if not self.builds:
            self.prepare()

    def prepare(self) -> None:
        """Build the engine now, if it is not there."""
        self._built()

    def max_commands(self) -> Vector:
        """Return the highest torques of the motors' shafts, shape (motors,), in N m or N."""
        return self._built().equipment.most.copy()

    # Where a robot may begin -------------------------------------------------------------------

    def neutral(self) -> Vector:
        """Return the robot's positions at rest, shape (nq,).

        Joints are at 0, or in the middle of their limits if 0 is not within them; a floating base
        is where the world puts it.
        """
        engine = self._built()
        found: Vector = engine.first.positions[engine.part.positions].copy()
        layout, joints = engine.simulation.layout, engine.part.joints
        lower, upper = layout.lower[joints], layout.upper[joints]
        joint_positions = found[len(found) - len(lower) :]
        joint_positions.fill(0.0)
        outside = (lower > 0.0) | (upper < 0.0)
        joint_positions[outside] = 0.5 * (lower + upper)[outside] if outside.any() else 0.0
        return found

    def grounded(self, positions: Vector) -> Vector:
        """Return the robot's positions with a floating base moved so that it stands on the ground.

        Args:
            positions: Of the robot, shape (nq,).

        Returns:
            New positions: the base moved along the ground's normal until the robot touches it;
            the same ones where there is no ground, or nothing that touches.
        """
        engine = self._built()
        q = np.array(positions, np.float64)
        if self.world.ground is None or not engine.part.floating:
            return q
        whole = engine.first.positions.copy()
        whole[engine.part.positions] = q
        q[:3] += rise(engine.simulation, self.world.ground, engine.part.name, whole)
        return q


def _all_of(option: str, kind: type[Any], given: Any) -> tuple[Any, ...] | None:
    """Return a list of motors or sensors as a tuple; None stays None.

    Raises:
        ConfigError: It is something else.
    """
    if given is None:
        return None
    name = kind.__name__
    wanted = f"{option} must be a list of {name}s, as in [{name}(...)]"
    if isinstance(given, (str, Mapping)) or not isinstance(given, Iterable):
        raise ConfigError(f"{wanted}, not {given!r}.")
    found = tuple(given)
    for each in found:
        if not isinstance(each, kind):
            raise ConfigError(f"{wanted}; {each!r} is none.")
    return found


def positive_or_none(option: str, value: float | None) -> float | None:
    """Return a period in s; None stays None."""
    return None if value is None else checks.positive(option, value)
