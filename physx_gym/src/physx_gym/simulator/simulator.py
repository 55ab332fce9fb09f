"""A world that is ready to run: options, forces, and the loop's steps."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from physx_core import checks
from physx_core.errors import (
    ComponentNotFoundError,
    ConfigError,
    EpisodeError,
    SimulationError,
    UnknownOptionError,
)
from physx_core.simulation import Ground, HeightField, Robot, Stairs, World, Wrench
from physx_core.typing import Vector
from physx_gym.simulator import options as nested_options
from physx_gym.simulator.equipped_world import Engine, EquippedWorld, positive_or_none


class Simulator(EquippedWorld):
    """A world ready to run, whose engine is built when it is first needed.

    It can be pickled and copied, also while it runs: the engine is then built anew and goes on from
    the same state. See `EquippedWorld` for its constructor and attributes.
    """

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
        """Make a simulator of one robot.

        Args:
            urdf: Path of its URDF file, or the name of one that the backend knows.
            fixed_base: Whether its root link is welded to the world.
            ground: What it stands on; None: a plane under a robot whose base floats, or nothing.
            period: Of the physics, in s.
            gravity: In m/s².
            objects: What else is in the world.
            package_dirs: Folders of the packages that its meshes are in.
            options: Of `Simulator`.
        """
        if ground is None and not fixed_base:
            ground = Ground()
        robot = Robot(urdf, fixed_base=fixed_base, package_dirs=package_dirs or {})
        return cls(World([robot], period, gravity, objects, ground), **options)

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
        """Change options; those that are left out stay. The engine is rebuilt if it has to be.

        Args:
            options: In the form that `get_options` returns.

        Raises:
            EpisodeError: An episode runs.
            UnknownOptionError: There is no option of that name.
            ConfigError: A value cannot be.
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
            setattr(self, name, positive_or_none(name, value))
        if world is not self.world:
            self.world, self._stale, self.stepper_state.dt = world, True, world.period
        if tuple(motors.values()) != self.motors:
            self._motors = self._given_motors = tuple(motors.values())
            self._stale = True
        if tuple(sensors.values()) != self.sensors:
            self._sensors = self._given_sensors = tuple(sensors.values())
            self._stale = True

    def seed(self, seed: Any) -> None:
        """Draw all errors of sensors from a seed, from the next start on."""
        self._random = np.random.default_rng(seed)

    def set_moment(self, steps: int) -> None:
        """Say that measurements are read at multiples of so many physics steps from a start.

        Sensors then measure no more often than that where it makes no difference.
        """
        self._moment = steps

    # Forces ----------------------------------------------------------------------------------

    def register_force(self, wrench: Wrench, begin: float = 0.0) -> None:
        """Let a force act in the episode that comes; to be called in `RobotEnv._setup`.

        `RobotEnv.reset` first removes what was registered before. To push a robot in an episode,
        use ``simulation.apply_wrench``.

        Args:
            wrench: Held, for a while, or along a profile; see `Wrench`.
            begin: When it begins, in s after the episode's begin, rounded to a physics step.

        Raises:
            EpisodeError: An episode runs.
            ConfigError: It is no wrench, or begins before the episode.
            ComponentNotFoundError: The world has no body of that name.
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
        """Forget all registered forces.

        Raises:
            EpisodeError: An episode runs.
        """
        self._check_stopped("remove_all_forces")
        self._forces = []

    # Running ---------------------------------------------------------------------------------

    def start(self, positions: Vector, velocities: Vector) -> None:
        """Begin at a state, at time 0.

        Args:
            positions: Of the robot that acts, shape (nq,), or of the whole world.
            velocities: Likewise, shape (nv,).

        Raises:
            EpisodeError: It runs already.
            SimulationError: The state makes no sense.
        """
        self._check_stopped("start")
        engine = self._built()
        first, part = engine.first, engine.part
        q = _whole("positions", positions, first.positions, part.positions)
        v = _whole("velocities", velocities, first.velocities, part.velocities)
        engine.simulation.restore(first)
        engine.simulation.set_state(q, v)
        self.robot_state.command.fill(0.0)
        engine.equipment.begin(self._random, self._moment)
        self._pending = list(self._forces)
        self.stepper_state.iter = 0
        self._push(engine)
        self._measure(engine)
        self.robot_state.expire()
        self.is_simulation_running[...] = True

    def apply_command(self) -> None:
        """Let the motors take over ``robot_state.command``."""
        engine = self._engine or self._built()
        engine.equipment.command(self.robot_state.command)

    def step(self, steps: int) -> None:
        """Simulate physics steps, and measure.

        Args:
            steps: How many.

        Raises:
            EpisodeError: It does not run.
            SimulationError: The state is no longer finite.
        """
        engine, stepper = self._engine, self.stepper_state
        if engine is None or not self.is_simulation_running:
            raise EpisodeError("The simulator does not run: call start, or reset.")
        if self._pending:
            steps = self._step_pushed(engine, steps)
        engine.simulation.step(steps)
        stepper.iter += steps
        self._measure(engine)

    def _step_pushed(self, engine: Engine, steps: int) -> int:
        """Simulate to the last force that begins within so many steps; return what is left."""
        stepper = self.stepper_state
        while self._pending and self._pending[0][0] < stepper.iter + steps:
            ahead = self._pending[0][0] - stepper.iter
            engine.simulation.step(ahead)
            stepper.iter += ahead
            steps -= ahead
            self._push(engine)
        return steps

    def _push(self, engine: Engine) -> None:
        """Let the registered forces act whose time has come."""
        while self._pending and self._pending[0][0] <= self.stepper_state.iter:
            engine.simulation.apply_wrench(self._pending.pop(0)[1])

    def _measure(self, engine: Engine) -> None:
        simulation, stepper = engine.simulation, self.stepper_state
        simulation.positions(self.positions)
        simulation.velocities(self.velocities)
        self.values[0] = stepper.t = stepper.iter * stepper.dt
        engine.equipment.measure(self._state, self._sensed)

    def stop(self) -> None:
        """End the episode; what was measured last stays. Stopping again does nothing."""
        self.is_simulation_running[...] = False

    def close(self) -> None:
        """Stop, and free the engine; it is built again when it is next needed."""
        self.stop()
        if self._engine is not None:
            self.robot_state.disconnect()
            self._drop()
            self._stale = True

    # State -----------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """Return everything that `restore` needs to go on exactly from here; plain data."""
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
            "moment": self._moment,
            "running": bool(self.is_simulation_running),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go back to a snapshot.

        Raises:
            SimulationError: It is of another simulator.
        """
        self._restore(self._built(), state)

    def _restore(self, engine: Engine, state: Mapping[str, Any]) -> None:
        values: Any = state.get("values") if isinstance(state, Mapping) else None
        if np.shape(values) != self.values.shape:
            raise SimulationError("The snapshot is not of this simulator: its values differ.")
        engine.simulation.restore(state["simulation"])
        self._random.bit_generator.state = state["random"]
        self._moment = state["moment"]
        engine.equipment.restore(state["equipment"], self._random, self._moment)
        np.copyto(self.values, state["values"])
        np.copyto(self.robot_state.command, state["command"])
        self._forces, self._pending = list(state["forces"]), list(state["pending"])
        self.stepper_state.iter = state["frame"]
        self.stepper_state.t = state["frame"] * engine.simulation.period
        self.robot_state.recall(state["accelerations"], state["torques"])
        self.is_simulation_running[...] = state["running"]

    def __getstate__(self) -> dict[str, Any]:
        """Return the description and the buffers, with a snapshot of the engine."""
        found = super().__getstate__()
        if self._engine is not None and not self._stale:
            found["_snapshot"] = self.snapshot()
        return found

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take up description and buffers, and build the engine."""
        snapshot = state.pop("_snapshot", None)
        super().__setstate__(state)
        self._engine, self._stale = None, True
        if snapshot is not None:
            engine = self._build()
            self.robot_state.connect(engine.simulation, engine.equipment, engine.part)
            self._restore(engine, snapshot)

    def _check_stopped(self, method: str) -> None:
        if self.is_simulation_running:
            raise EpisodeError(
                f"{method} is not for a running episode: call stop() first, or do it in _setup, "
                "which reset calls."
            )


_STEPPER = ("control_period", "observe_period")


def simulator_of(thing: Any, options: Mapping[str, Any]) -> Simulator:
    """Return a simulator of a world, or of a robot's file or name.

    Raises:
        ConfigError: It is none of these, or an option does not exist.
    """
    make: Any = Simulator if isinstance(thing, World) else Simulator.build
    if not isinstance(thing, (World, str, Path)):
        raise ConfigError(
            f"An environment needs a Simulator, a World, or the path or name of a robot, not "
            f"{thing!r}."
        )
    takers: list[Any] = [Simulator] if make is Simulator else [Simulator, Simulator.build]
    known = {name for taker in takers for name in inspect.signature(taker).parameters}
    known -= {"world", "urdf", "options"}
    unknown = set(options) - known
    if unknown:
        raise UnknownOptionError("Simulator", unknown, known)
    found: Simulator = make(thing, **options)
    return found


def _whole(kind: str, given: Any, first: Vector, part: slice) -> Vector:
    """Return a vector of the whole world with that of a robot in its place."""
    vector = np.asarray(given, np.float64)
    if vector.shape == first.shape:
        return vector
    length = part.stop - part.start
    if vector.shape != (length,):
        raise SimulationError(
            f"The first {kind} have the shape {vector.shape}, but need ({length},) for the robot, "
            f"or {first.shape} for the whole world."
        )
    whole = first.copy()
    whole[part] = vector
    return whole
