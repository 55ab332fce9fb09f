"""A world with its engine, motors and sensors, ready to run."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from physx_core import Closeable, checks, plugins
from physx_core.errors import ComponentNotFoundError, ConfigError, EpisodeError
from physx_core.typing import Vector
from physx_gym.defaults import BACKEND
from physx_gym.shared_arrays import SharedArrays
from physx_gym.simulator import options as nested_options
from physx_gym.simulator.equipment import Equipment, default_motors, default_sensors
from physx_gym.simulator.ground_placement import offset_to_ground
from physx_gym.simulator.states import RobotState, StepperState
from physx_sim import (
    Ground,
    HeightField,
    Layout,
    Motor,
    Part,
    Robot,
    Sensor,
    Simulation,
    Stairs,
    State,
    World,
    Wrench,
    with_rotors,
)
from physx_sim.engines import RobotModel, read_robot
from physx_sim.errors import SimulationError

_CHANGES = {"changes", "gravity"}
"""Features of an engine whose world can get other masses, friction and gravity."""
_STEPPER = ("control_period", "observe_period")


@dataclass(frozen=True)
class Engine:
    """A built engine; it can be rebuilt from the simulator's description.

    Attributes:
        simulation: The engine's simulation.
        equipment: The motors and sensors on it.
        part: The controlled robot's part of the state.
        first: The state right after building, with the masses, friction and gravity of now.
        masses: Masses of the robots' links as built, by the names of bodies, once needed.
        models: The controlled robot's model, once needed.
    """

    simulation: Simulation
    equipment: Equipment
    part: Part
    first: State
    masses: dict[str, float] = field(default_factory=dict)
    models: list[RobotModel] = field(default_factory=list)


class Simulator(SharedArrays, Closeable):
    """A world ready to run, whose engine is built when it is first needed.

    It can be pickled and copied, even while running: the copy builds its own engine and continues
    from the same state.

    Attributes:
        world: The simulated world, without the rotors that the motors add.
        backend: Reference of the engine.
        control_period: Time between two commands, in s; None: one step of the environment.
        observe_period: Time between two observations, in s; None: the control period.
        builds: How often the engine has been built.
        is_simulation_running: Whether an episode is running; shape ().
        stepper_state: Time and number of physics steps.
        values: All measured values: time, positions, velocities, sensors.
        positions: Of the whole world, shape (nq,); a view of `values`.
        velocities: Of the whole world, shape (nv,); a view of `values`.
        robot_state: State of the controlled robot; its positions and velocities are views too.
        measurements: The measured values as nested dictionaries of views.
    """

    _left_out: ClassVar[frozenset[str]] = frozenset({"_engine"})

    def __init__(
        self,
        world: World,
        *,
        backend: Any = BACKEND,
        robot: str | None = None,
        motors: Sequence[Motor] | None = None,
        sensors: Sequence[Sensor] | None = None,
        control_period: float | None = None,
        observe_period: float | None = None,
    ) -> None:
        """Describe a simulator.

        Args:
            world: The world to simulate.
            backend: Reference of the engine.
            robot: Name of the controlled robot; None: the first.
            motors: None: an ideal motor on each of the robot's joints that has a torque limit.
            sensors: None: an encoder on each motor's joint and, if the base floats, an inertial
                sensor on the root link, all ideal.
            control_period: In s; None: once a step of the environment.
            observe_period: In s; None: as often as commands.

        Raises:
            ConfigError: If an option is invalid.
            ComponentNotFoundError: If the world has no robot of that name.
        """
        if not isinstance(world, World):
            raise ConfigError(f"A Simulator needs a World, not {world!r}.")
        names = [each.name for each in world.robots]
        if not names:
            raise ConfigError("The world has no robot to control: World([Robot(...)], ...).")
        if robot is not None and robot not in names:
            raise ComponentNotFoundError("robot", str(robot), "The world", names)
        self.world = self._built_world = world
        self.backend = backend
        self._robot_name = names[0] if robot is None else robot
        self._given_motors = None if motors is None else checks.things("motors", motors, Motor)
        self._given_sensors = None if sensors is None else checks.things("sensors", sensors, Sensor)
        self._motors: tuple[Motor, ...] = self._given_motors or ()
        self._sensors: tuple[Sensor, ...] = self._given_sensors or ()
        self.control_period = _positive_or_none("control_period", control_period)
        self.observe_period = _positive_or_none("observe_period", observe_period)
        self.builds = 0
        self.is_simulation_running = np.zeros((), np.bool_)
        self.stepper_state = StepperState(dt=world.period)
        self._random = np.random.default_rng()
        self._forces: list[tuple[int, Wrench]] = []
        self._pending: list[tuple[int, Wrench]] = []
        self._reading_period = 1
        self._engine: Engine | None = None
        self._stale = False

    @classmethod
    def build(
        cls,
        urdf: str | Path,
        *,
        fixed_base: bool = True,
        ground: Ground | Stairs | HeightField | None = None,
        period: float = 1e-3,
        gravity: tuple[float, ...] = (0.0, 0.0, -9.81),
        objects: Sequence[Any] = (),
        package_dirs: Mapping[str, str | Path] | None = None,
        **options: Any,
    ) -> Self:
        """Return a simulator of one robot.

        Args:
            urdf: Path of its URDF file, or the name of a robot that the backend provides.
            fixed_base: Whether its root link is welded to the world.
            ground: The ground; None: a plane under a robot whose base floats, otherwise none.
            period: Of the physics, in s.
            gravity: In m/s².
            objects: Other objects in the world.
            package_dirs: Folders of the packages that contain its meshes.
            options: Of `Simulator`.
        """
        if ground is None and not fixed_base:
            ground = Ground()
        robot = Robot(urdf, fixed_base=fixed_base, package_dirs=package_dirs or {})
        return cls(World([robot], period, gravity, objects, ground), **options)

    # The engine ------------------------------------------------------------------------------

    def _built(self) -> Engine:
        """Return the engine; build it first if it is missing or if options have changed."""
        engine = self._engine
        if engine is None or self._stale:
            engine = self._build()
            self._allocate(engine)
        return engine

    def _build(self) -> Engine:
        """Build engine, motors and sensors."""
        self._drop()
        backend = plugins.resolve("backend", self.backend)
        world = with_rotors(self._built_world, self._given_motors or ())
        simulation: Simulation = backend.build(world)
        if self.world is not self._built_world and not simulation.features >= _CHANGES:
            simulation.close()
            self._built_world = self.world
            world = with_rotors(self.world, self._given_motors or ())
            simulation = backend.build(world)
        part = simulation.layout.parts[self._robot_name]
        if self._given_motors is None:
            self._motors = default_motors(simulation.layout, part)
        if self._given_sensors is None:
            self._sensors = default_sensors(simulation, part, self._motors)
        random = np.random.default_rng(0)  # biases are redrawn at each start
        equipment = Equipment(simulation, world, self._motors, self._sensors, random)
        self._sensors = equipment.sensor_list
        self._engine = Engine(simulation, equipment, part, simulation.snapshot())
        self._stale = False
        self.builds += 1
        self._change_world(self._engine)
        return self._engine

    def _change_world(self, engine: Engine) -> None:
        """Give the built engine the masses, friction and gravity of the world."""
        if self.world is self._built_world and not engine.first.bodies:
            return
        simulation, built, masses = engine.simulation, self._built_world, engine.masses
        if not masses:
            masses.update(nested_options.link_masses(built, simulation.layout))
        bodies = nested_options.body_changes(built, self.world, simulation.layout, masses)
        first = replace(engine.first, bodies=bodies, gravity=np.array(self.world.gravity))
        simulation.restore(first)
        self._engine = replace(engine, first=first)

    def _drop(self) -> None:
        if self._engine is not None:
            self._engine.simulation.close()
            self._engine = None

    def _allocate(self, engine: Engine) -> None:
        """Allocate the buffers of the measured values: views of one array."""
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
        """Return an array laid out like `values` as nested dictionaries of views."""
        engine = self._built()
        q, v = values[1 : self._sizes[0]], values[self._sizes[0] : self._sizes[1]]
        agent = {"q": q[engine.part.positions], "v": v[engine.part.velocities]}
        found: dict[str, Any] = {"t": values[:1].reshape(()), "states": {"agent": agent}}
        sensed = engine.equipment.by_kind(values[self._sizes[1] :])
        if sensed:
            found["measurements"] = sensed
        return found

    def change_backend(self, backend: Any) -> None:
        """Simulate with another engine from now on.

        Args:
            backend: Reference of the engine.

        Raises:
            EpisodeError: If an episode is running.
        """
        self._check_stopped("change_backend")
        self.backend, self._stale = backend, True

    def prepare(self) -> None:
        """Build the engine now, unless it is already built."""
        self._built()

    @property
    def motors(self) -> tuple[Motor, ...]:
        """The motors of the controlled robot, in the order of its command."""
        if not self.builds:  # only the engine knows the robot's joints
            self.prepare()
        return self._motors

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """The sensors, grouped by kind."""
        if not self.builds:
            self.prepare()
        return self._sensors

    @property
    def sensed(self) -> dict[str, Vector]:
        """The latest measurement of the sensors of each kind, shape (values, sensors)."""
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
        """The controlled robot's part of the state."""
        return self._built().part

    @property
    def period(self) -> float:
        """Duration of a physics step, in s."""
        return self.world.period

    def max_commands(self) -> Vector:
        """Return the maximum torques of the motors' shafts, shape (motors,), in N m or N."""
        return self._built().equipment.max_commands.copy()

    # Initial positions -----------------------------------------------------------------------

    def neutral(self) -> Vector:
        """Return the robot's neutral positions, shape (nq,).

        Joints are at 0, or in the middle of their limits if 0 is outside them, or the nearest
        position that leaders and couplings allow; a floating base is where the world puts it.
        """
        engine = self._built()
        found: Vector = engine.first.positions[engine.part.positions].copy()
        layout, joints = engine.simulation.layout, engine.part.joints
        lower, upper = layout.lower[joints], layout.upper[joints]
        joint_positions = found[len(found) - len(lower) :]
        joint_positions.fill(0.0)
        outside = (lower > 0.0) | (upper < 0.0)
        joint_positions[outside] = 0.5 * (lower + upper)[outside] if outside.any() else 0.0
        if not engine.models:
            (robot,) = (each for each in self.world.robots if each.name == self._robot_name)
            engine.models.append(read_robot(robot))
        joint_positions[:] = engine.models[0].allowed(joint_positions)
        return found

    def place_on_ground(self, positions: Vector) -> Vector:
        """Return the robot's positions with a floating base moved so that it stands on the ground.

        Args:
            positions: Of the robot, shape (nq,).

        Returns:
            New positions, with the base moved along the ground's normal until the robot touches
            it; unchanged if there is no ground or nothing that can touch it.
        """
        engine = self._built()
        q = np.array(positions, np.float64)
        if self.world.ground is None or not engine.part.floating:
            return q
        whole = engine.first.positions.copy()
        whole[engine.part.positions] = q
        q[:3] += offset_to_ground(engine.simulation, self.world.ground, engine.part.name, whole)
        return q

    # Options ---------------------------------------------------------------------------------

    def get_options(self) -> dict[str, Any]:
        """Return all options as nested plain data.

        Returns:
            ``"world"`` with ``"ground"``, and ``"robots"`` and ``"objects"`` by name;
            ``"stepper"``; ``"motors"`` by joint; ``"sensors"`` by name.
        """
        return {
            "world": nested_options.world_options(self.world),
            "stepper": {name: getattr(self, name) for name in _STEPPER},
            "motors": nested_options.motor_options(self.motors),
            "sensors": nested_options.sensor_options(self.sensors),
        }

    def set_options(self, options: Mapping[str, Any]) -> None:
        """Change options; omitted ones stay the same.

        Masses, friction and gravity change in the built engine; others need a new build.

        Args:
            options: In the form that `get_options` returns.

        Raises:
            EpisodeError: If an episode is running.
            UnknownOptionError: If there is no option of that name.
            ConfigError: If a value is out of range.
        """
        self._check_stopped("set_options")
        nested_options.check_known("", options, ("world", "stepper", "motors", "sensors"))
        world = nested_options.change_world(self.world, options.get("world", {}))
        motors = {motor.joint: motor for motor in self.motors}
        motors = nested_options.change_each("motors", motors, options.get("motors", {}))
        sensors = {sensor.name: sensor for sensor in self.sensors}
        sensors = nested_options.change_each("sensors", sensors, options.get("sensors", {}))
        stepper = options.get("stepper", {})
        nested_options.check_known("stepper", stepper, _STEPPER)
        for name, value in stepper.items():
            setattr(self, name, _positive_or_none(name, value))
        if world is not self.world:
            self._take(world, options["world"])
        if tuple(motors.values()) != self.motors:
            self._motors = self._given_motors = tuple(motors.values())
            self._stale = True
        if tuple(sensors.values()) != self.sensors:
            self._sensors = self._given_sensors = tuple(sensors.values())
            self._stale = True

    def _take(self, world: World, options: Mapping[str, Any]) -> None:
        """Take over a changed world: in the running engine, if that can."""
        needed = nested_options.needing_a_build(options)
        built = nested_options.change_world(self._built_world, needed)
        self.world, self.stepper_state.dt = world, world.period
        engine = self._engine
        if built is self._built_world and engine is not None and not self._stale:
            if engine.simulation.features >= _CHANGES:
                self._change_world(engine)
                return
            built = world
        self._built_world, self._stale = built, True

    def seed(self, seed: Any) -> None:
        """Seed the sensors' errors, from the next start on."""
        self._random = np.random.default_rng(seed)

    def set_reading_period(self, steps: int) -> None:
        """Declare that measurements are only read at multiples of a number of physics steps.

        Sensors then measure no more often than that, unless it makes a difference.
        """
        self._reading_period = steps

    # Forces ----------------------------------------------------------------------------------

    def register_force(self, wrench: Wrench, begin: float = 0.0) -> None:
        """Apply a force during the next episode; call this in `RobotEnv._setup`.

        `RobotEnv.reset` first removes all forces registered before. To push a robot during an
        episode, use ``simulation.apply_wrench``.

        Args:
            wrench: Constant, limited in time, or along a profile; see `Wrench`.
            begin: Time from the start of the episode, in s, rounded to a physics step.

        Raises:
            EpisodeError: If an episode is running.
            ConfigError: If it is not a `Wrench`, or begins before the episode.
            ComponentNotFoundError: If the world has no body of that name.
        """
        self._check_stopped("register_force")
        if not isinstance(wrench, Wrench):
            raise ConfigError(f"register_force takes a Wrench, not {wrench!r}.")
        names = self.layout.names
        if wrench.body not in names:
            raise ComponentNotFoundError("body", wrench.body, "The world", names)
        frame = round(checks.not_negative("begin", begin) / self.period)
        self._forces = sorted([*self._forces, (frame, wrench)], key=lambda pair: pair[0])

    def remove_all_forces(self) -> None:
        """Remove all registered forces.

        Raises:
            EpisodeError: If an episode is running.
        """
        self._check_stopped("remove_all_forces")
        self._forces = []

    # Running ---------------------------------------------------------------------------------

    def start(self, positions: Vector, velocities: Vector) -> None:
        """Start from a state, at time 0.

        Args:
            positions: Of the controlled robot, shape (nq,), or of the whole world.
            velocities: Likewise, shape (nv,).

        Raises:
            EpisodeError: If an episode is already running.
            SimulationError: If the state has the wrong size or is not finite.
        """
        self._check_stopped("start")
        engine = self._built()
        first, part = engine.first, engine.part
        q = _whole("positions", positions, first.positions, part.positions)
        v = _whole("velocities", velocities, first.velocities, part.velocities)
        engine.simulation.restore(replace(first, positions=q, velocities=v, native=(), engine=""))
        self.robot_state.command.fill(0.0)
        engine.equipment.begin(self._random, self._reading_period)
        self._pending = list(self._forces)
        self.stepper_state.iter = 0
        self._apply_forces(engine)
        self._measure(engine)
        self.robot_state.expire()
        self.is_simulation_running[...] = True

    def apply_command(self) -> None:
        """Send ``robot_state.command`` to the motors."""
        engine = self._engine or self._built()
        engine.equipment.command(self.robot_state.command)

    def step(self, steps: int) -> None:
        """Simulate a number of physics steps, then measure.

        Raises:
            EpisodeError: If no episode is running.
            SimulationError: If the state is no longer finite.
        """
        engine, stepper = self._engine, self.stepper_state
        if engine is None or not self.is_simulation_running:
            raise EpisodeError("The simulator is not running: call start, or reset.")
        if self._pending:
            steps = self._step_to_forces(engine, steps)
        engine.simulation.step(steps)
        stepper.iter += steps
        self._measure(engine)

    def _step_to_forces(self, engine: Engine, steps: int) -> int:
        """Simulate up to the last force that begins within these steps; return the steps left."""
        stepper = self.stepper_state
        while self._pending and self._pending[0][0] < stepper.iter + steps:
            ahead = self._pending[0][0] - stepper.iter
            engine.simulation.step(ahead)
            stepper.iter += ahead
            steps -= ahead
            self._apply_forces(engine)
        return steps

    def _apply_forces(self, engine: Engine) -> None:
        """Apply the registered forces that are due."""
        while self._pending and self._pending[0][0] <= self.stepper_state.iter:
            engine.simulation.apply_wrench(self._pending.pop(0)[1])

    def _measure(self, engine: Engine) -> None:
        simulation, stepper = engine.simulation, self.stepper_state
        simulation.positions(self.positions)
        simulation.velocities(self.velocities)
        self.values[0] = stepper.t = stepper.iter * stepper.dt
        engine.equipment.measure(self._state, self._sensed)

    def stop(self) -> None:
        """End the episode; the last measurement stays. Stopping again does nothing."""
        self.is_simulation_running[...] = False

    def close(self) -> None:
        """Stop, and free the engine; it is rebuilt when it is next needed."""
        self.stop()
        if self._engine is not None:
            self.robot_state.disconnect()
            self._drop()
            self._stale = True

    # State -----------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """Return everything that `restore` needs to continue exactly from here, as plain data."""
        engine = self._built()
        return {
            "simulation": engine.simulation.snapshot(),
            "equipment": engine.equipment.snapshot(),
            "values": self.values.copy(),
            "command": self.robot_state.command.copy(),
            "accelerations": self.robot_state.a.copy(),
            "torques": self.robot_state.torques.copy(),
            "frame": self.stepper_state.iter,
            "forces": tuple(self._forces),
            "pending": tuple(self._pending),
            "random": self._random.bit_generator.state,
            "reading_period": self._reading_period,
            "running": bool(self.is_simulation_running),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a snapshot.

        Raises:
            SimulationError: If the snapshot is of another simulator.
        """
        engine = self._built()
        values: Any = state.get("values") if isinstance(state, Mapping) else None
        if np.shape(values) != self.values.shape:
            raise SimulationError("The snapshot is not of this simulator: its size differs.")
        engine.simulation.restore(state["simulation"])
        self._random.bit_generator.state = state["random"]
        self._reading_period = state["reading_period"]
        engine.equipment.restore(state["equipment"], self._random, self._reading_period)
        np.copyto(self.values, state["values"])
        np.copyto(self.robot_state.command, state["command"])
        self._forces, self._pending = list(state["forces"]), list(state["pending"])
        self.stepper_state.iter = state["frame"]
        self.stepper_state.t = state["frame"] * engine.simulation.period
        self.robot_state.restore_memory(state["accelerations"], state["torques"])
        self.is_simulation_running[...] = state["running"]

    def __getstate__(self) -> dict[str, Any]:
        """Return the description, the buffers, and a snapshot of the engine."""
        found = super().__getstate__()
        if self._engine is not None and not self._stale:
            found["_snapshot"] = self.snapshot()
        return found

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore description and buffers, and build the engine."""
        snapshot = state.pop("_snapshot", None)
        super().__setstate__(state)
        self._engine, self._stale = None, True
        if snapshot is not None:
            engine = self._build()
            self.robot_state.connect(engine.simulation, engine.equipment, engine.part)
            self.restore(snapshot)

    def _check_stopped(self, method: str) -> None:
        if self.is_simulation_running:
            raise EpisodeError(
                f"{method} cannot be called during an episode: call stop() first, or call it in "
                "_setup, which reset runs."
            )


def make_simulator(thing: Any, options: Mapping[str, Any]) -> tuple[Simulator, dict[str, Any]]:
    """Return a simulator of a world, or of a robot's file or name, and the remaining options."""
    if isinstance(thing, Simulator):
        return thing, dict(options)
    make: Any = Simulator if isinstance(thing, World) else Simulator.build
    if not isinstance(thing, (World, str, Path)):
        raise ConfigError(
            f"An environment needs a Simulator, a World, or the path or name of a robot, not "
            f"{thing!r}."
        )
    known = simulator_options(thing)
    own = {name: value for name, value in options.items() if name in known}
    return make(thing, **own), {name: options[name] for name in options.keys() - own.keys()}


def simulator_options(thing: Any) -> set[str]:
    """Return the names of the simulator options that `make_simulator` accepts for a thing."""
    if isinstance(thing, Simulator):
        return set()
    takers: list[Any] = [Simulator, *(() if isinstance(thing, World) else (Simulator.build,))]
    known = {name for taker in takers for name in inspect.signature(taker).parameters}
    return known - {"world", "urdf", "options"}


def _positive_or_none(option: str, value: float | None) -> float | None:
    return None if value is None else checks.positive(option, value)


def _whole(kind: str, given: Any, first: Vector, part: slice) -> Vector:
    """Return a vector of the whole world, given one of the robot or of the whole world."""
    vector = np.asarray(given, np.float64)
    if vector.shape == first.shape:
        return vector
    length = part.stop - part.start
    if vector.shape != (length,):
        raise SimulationError(
            f"The initial {kind} have the shape {vector.shape}, but need ({length},) for the "
            f"robot, or {first.shape} for the whole world."
        )
    whole = first.copy()
    whole[part] = vector
    return whole
