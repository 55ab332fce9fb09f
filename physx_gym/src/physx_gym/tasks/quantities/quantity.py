"""Quantities, the moments they are computed for, and the quantities of an environment."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core import checks
from physx_core.errors import ComponentNotFoundError, ConfigError
from physx_core.typing import Records, Vector
from physx_gym.simulator.simulator import Simulator
from physx_gym.spaces import copy_tree
from physx_gym.tasks.trajectory import Trajectory
from physx_sim import Part, Simulation
from physx_sim.errors import FeatureNotSupportedError


class Quantity(ABC):
    """A value of the present moment that rewards, terminations and observers share.

    Subclasses are frozen dataclasses whose options are hashable: equal quantities are computed at
    most once for each state of the simulation. The values of other quantities are obtained with
    `Moment.get`.
    """

    def __post_init__(self) -> None:
        """Store numbers as declared and lists as tuples; check that its parts are quantities.

        Raises:
            ConfigError: If they are not, a string is given instead of a list, or an option is not
                of the declared kind of number.
        """
        checks.store_declared(f"{type(self).__name__}.", self)
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value, where = getattr(self, field.name), f"{type(self).__name__}.{field.name}"
            if isinstance(value, list):
                value = tuple(value)
                object.__setattr__(self, field.name, value)
            if isinstance(value, str) and str(field.type).startswith("tuple"):
                raise ConfigError(f'{where} is the string "{value}" but must be a list.')
            if field.name in ("quantity", "quantities"):
                for each in value if isinstance(value, tuple) else (value,):
                    check_quantity(where, each)

    @abstractmethod
    def compute(self, moment: Moment) -> Any:
        """Return the value: a number or an array, new each time.

        Args:
            moment: The state to compute it for.
        """


class Remembering(Quantity):
    """A quantity of the present and previous steps of the environment.

    Its value is updated once a step, whether or not it is used.
    """

    @abstractmethod
    def advance(self, memory: Any, moment: Moment) -> tuple[Any, Any]:
        """Return the value after this step, and what to remember for the next.

        Args:
            memory: What was remembered in the previous step; None: start of an episode.
            moment: The state after this step.
        """

    def compute(self, moment: Moment) -> Any:
        """Return the value as of the last step."""
        return moment.remembered(self)


@dataclass(frozen=True)
class Reference(Quantity):
    """Another quantity, computed for the reference trajectory's state at this time.

    Attributes:
        quantity: A quantity that depends on positions and velocities only.
    """

    quantity: Quantity

    def compute(self, moment: Moment) -> Any:
        """Return the value on the trajectory."""
        return moment.reference().get(self.quantity)


class Moment:
    """A state that quantities are computed for: the present one, or that of a trajectory.

    Attributes:
        simulator: The simulator.
        t: Time of the episode, in s.
        q: Positions of the controlled robot, shape (nq,).
        v: Its velocities, shape (nv,).
        is_present: Whether it is the simulation's state, so that contacts and torques are known.
    """

    def __init__(self, owner: Quantities, t: float, state: tuple[Vector, Vector] | None) -> None:
        """Keep the state.

        Args:
            owner: The quantities of the environment.
            t: Time, in s.
            state: Positions and velocities of the robot; None: the present ones.
        """
        self.simulator = owner.simulator
        self.t, self.is_present = t, state is None
        self.q = self.simulator.robot_state.q if state is None else state[0]
        self.v = self.simulator.robot_state.v if state is None else state[1]
        self._owner = owner
        self._values: dict[Quantity, Any] = {}
        self._whole: tuple[Vector, Vector] | None = None

    @property
    def robot(self) -> Part:
        """The robot's part of the whole state."""
        return self.simulator.robot

    @property
    def simulation(self) -> Simulation:
        """The running simulation."""
        return self.simulator.simulation

    @property
    def step_dt(self) -> float:
        """Duration of a step of the environment, in s."""
        return self._owner.step_dt

    def get(self, quantity: Quantity) -> Any:
        """Return the value of a quantity, which must not be modified."""
        try:
            return self._values[quantity]
        except KeyError:
            value = self._values[quantity] = quantity.compute(self)
            return value

    def reference(self) -> Moment:
        """Return the same moment on the reference trajectory."""
        return self._owner.moment_of_reference(self.t)

    def remembered(self, quantity: Remembering) -> Any:
        """Return the value that a quantity with memory had after the last step.

        Raises:
            ConfigError: If the moment is on a trajectory.
        """
        if not self.is_present:
            raise ConfigError(
                f"{quantity} depends on previous steps, which Reference cannot provide: apply "
                "Reference to the quantity inside it."
            )
        return self._owner.remembered(quantity)

    # From the simulation -------------------------------------------------------------------

    def body_poses(self, names: tuple[str, ...]) -> Vector:
        """Return poses of bodies in the world, shape (names, 7): see `Simulation.body_poses`."""
        if self.is_present:
            return self.simulation.body_poses(names)
        return self.simulation.body_poses(names, self._state()[0])

    def body_velocities(self, names: tuple[str, ...]) -> Vector:
        """Return velocities of bodies, shape (names, 6): see `Simulation.body_velocities`."""
        if self.is_present:
            return self.simulation.body_velocities(names)
        return self.simulation.body_velocities(names, *self._state())

    def mass_matrix(self) -> Vector:
        """Return the mass matrix of the controlled robot, shape (nv, nv)."""
        own = self.robot.velocities
        whole = self.simulation.positions() if self.is_present else self._state()[0]
        return self.simulation.mass_matrix(whole)[own, own]

    def contacts(self) -> Records:
        """Return the contacts of the last physics step.

        Raises:
            FeatureNotSupportedError: If the moment is on a trajectory.
        """
        if not self.is_present:
            raise FeatureNotSupportedError("A trajectory", "contacts", ())
        return self.simulation.contacts()

    def _state(self) -> tuple[Vector, Vector]:
        """Return positions and velocities of the whole world, including those of the robot."""
        if self._whole is None:
            positions, velocities = self.simulation.positions(), self.simulation.velocities()
            positions[self.robot.positions] = self.q
            velocities[self.robot.velocities] = self.v
            self._whole = positions, velocities
        return self._whole


class Quantities(Mapping[str, Any]):
    """The quantities of an environment; see `RobotEnv.quantities`.

    As a mapping it contains the named ones: ``env.quantities["height"]`` is the present value.
    Without a name: ``env.quantities.get_value(BaseHeight())``.
    """

    def __init__(self, simulator: Simulator, step_dt: float) -> None:
        """Start without quantities.

        Args:
            simulator: The simulator of the environment.
            step_dt: Duration of a step of the environment, in s.
        """
        self.simulator, self.step_dt = simulator, step_dt
        self.trajectory: Trajectory | None = None
        self._named: dict[str, Quantity] = {}
        self._watched: dict[Quantity, None] = {}
        self._memories: dict[Remembering, tuple[Any, Any]] = {}
        self._begins = True
        self._present: Moment | None = None
        self._on_reference: Moment | None = None
        self._frame = -1

    # By name --------------------------------------------------------------------------------

    def add(self, name: str, quantity: Quantity) -> None:
        """Name a quantity.

        Raises:
            ConfigError: If the name is taken, or the quantity is not a `Quantity`.
        """
        check_quantity(f'The quantity "{name}"', quantity)
        if self._named.get(name, quantity) != quantity:
            raise ConfigError(f'There is already a quantity "{name}": {self._named[name]}.')
        self._named[name] = quantity
        self.watch(quantity)

    def remove(self, name: str) -> None:
        """Remove a name.

        Raises:
            ComponentNotFoundError: If there is no quantity of that name.
        """
        self._quantity(name)
        del self._named[name]

    def __getitem__(self, name: str) -> Any:
        """Return the present value of a named quantity."""
        return self.get_value(self._quantity(name))

    def __contains__(self, name: object) -> bool:
        """Return whether a quantity has this name."""
        return name in self._named

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._named)

    def __len__(self) -> int:
        """Return the number of names."""
        return len(self._named)

    def _quantity(self, name: str) -> Quantity:
        if name not in self._named:
            raise ComponentNotFoundError("quantity", name, "The environment", self._named)
        return self._named[name]

    # Values ---------------------------------------------------------------------------------

    def get_value(self, quantity: Quantity) -> Any:
        """Return the present value of a quantity."""
        return self.moment().get(quantity)

    def moment(self) -> Moment:
        """Return the present moment; it stays the same until the simulation continues."""
        state = self.simulator.stepper_state
        if self._present is None or self._frame != state.iter:
            self._frame = state.iter
            self._present, self._on_reference = Moment(self, state.t, None), None
        return self._present

    def moment_of_reference(self, t: float) -> Moment:
        """Return the moment of the reference trajectory at a time, in s.

        Raises:
            ConfigError: If there is no trajectory.
        """
        if self.trajectory is None:
            raise ConfigError(
                "A quantity needs the reference, but there is no trajectory: pass "
                "ComposedEnv(..., trajectory=...)."
            )
        if self._on_reference is None or self._on_reference.t != t:
            self._on_reference = Moment(self, t, self.trajectory.at(t))
        return self._on_reference

    def watch(self, quantity: Quantity) -> None:
        """Compute a quantity at the start of each episode, so that its memory starts there."""
        self._watched.setdefault(quantity)

    def remembered(self, quantity: Remembering) -> Any:
        """Return the value of a quantity with memory as of the last step."""
        if quantity not in self._memories:
            self._memories[quantity] = quantity.advance(None, self.moment())
        return self._memories[quantity][0]

    # Episodes -------------------------------------------------------------------------------

    def reset(self) -> None:
        """Discard all values and memories at the start of an episode."""
        self._present = self._on_reference = None
        self._frame = -1
        self._memories, self._begins = {}, True

    def clear(self) -> None:
        """Discard the values, and update the memories after a step.

        The first call after `reset` starts the memories with the initial state of the episode.
        """
        self._present = self._on_reference = None
        if self._begins:
            self._begins = False
            for watched in self._watched:
                self.get_value(watched)
        elif self._memories:
            moment = self.moment()
            # In order of creation: the parts of a quantity come before it.
            for quantity, (_, memory) in [*self._memories.items()]:
                self._memories[quantity] = quantity.advance(memory, moment)

    def snapshot(self) -> Any:
        """Return what is remembered."""
        return [(quantity, copy_tree(kept)) for quantity, kept in self._memories.items()]

    def restore(self, state: Any) -> None:
        """Restore what `snapshot` returned."""
        self.reset()
        self._begins = False
        self._memories = {quantity: copy_tree(kept) for quantity, kept in state}


def check_quantity(where: str, value: Any) -> Quantity:
    """Return a value after checking that it is a quantity.

    Raises:
        ConfigError: If it is not.
    """
    if not isinstance(value, Quantity):
        is_class = isinstance(value, type) and issubclass(value, Quantity)
        hint = f": create one, as in {value.__name__}(...)" if is_class else ""
        raise ConfigError(f"{where} is {value!r}, which is not a Quantity{hint}.")
    return value


def as_array(value: Any) -> Vector:
    """Return a value as an array of floats."""
    return np.asarray(value, np.float64)
