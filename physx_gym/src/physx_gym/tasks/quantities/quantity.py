"""What a quantity is, and the quantities of an environment."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core.errors import ComponentNotFoundError, ConfigError, FeatureNotSupportedError
from physx_core.simulation import Part, Simulation
from physx_core.typing import Records, Vector
from physx_gym.simulator.simulator import Simulator
from physx_gym.spaces import copy_tree
from physx_gym.tasks.trajectory import Trajectory


class Quantity(ABC):
    """A value of the present moment that rewards, terminations and observers share.

    Subclasses are frozen dataclasses whose options can be hashed: equal quantities are one, and are
    computed at most once for each state of the simulation. What another quantity says is asked for
    with `Moment.get`.
    """

    def __post_init__(self) -> None:
        """Take lists as tuples, and check that what it is made of are quantities.

        Raises:
            ConfigError: They are not, or a text is given for a list.
        """
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value, where = getattr(self, field.name), f"{type(self).__name__}.{field.name}"
            if isinstance(value, list):
                value = tuple(value)
                object.__setattr__(self, field.name, value)
            if isinstance(value, str) and str(field.type).startswith("tuple"):
                raise ConfigError(f'{where} is the text "{value}" but must be a list.')
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
    """A quantity of the present and of the steps before; it counts in steps of the environment.

    Its value changes once a step, whether anybody asks for it or not.
    """

    @abstractmethod
    def advance(self, memory: Any, moment: Moment) -> tuple[Any, Any]:
        """Return the value after this step, and what to remember for the next.

        Args:
            memory: What was remembered in the step before; None: there is none, this is the begin.
            moment: The state after this step.
        """

    def compute(self, moment: Moment) -> Any:
        """Return the value as of the last step."""
        return moment.remembered(self)


@dataclass(frozen=True)
class Reference(Quantity):
    """Another quantity where the reference trajectory is at this time.

    Attributes:
        quantity: One of positions and velocities.
    """

    quantity: Quantity

    def compute(self, moment: Moment) -> Any:
        """Return the value on the trajectory."""
        return moment.reference().get(self.quantity)


class Moment:
    """A state that quantities are computed for: the present one, or that of a trajectory.

    Attributes:
        simulator: What runs.
        t: Time of the episode, in s.
        q: Positions of the robot that acts, shape (nq,).
        v: Its velocities, shape (nv,).
        is_present: Whether it is the simulation's state, so that contacts and torques are known.
    """

    def __init__(self, owner: Quantities, t: float, state: tuple[Vector, Vector] | None) -> None:
        """Keep what the state is.

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
        """Place of the robot in the whole state."""
        return self.simulator.robot

    @property
    def simulation(self) -> Simulation:
        """The running simulation."""
        return self.simulator.simulation

    @property
    def step_dt(self) -> float:
        """Time of a step of the environment, in s."""
        return self._owner.step_dt

    def get(self, quantity: Quantity) -> Any:
        """Return the value of a quantity; to be read, not to be written to."""
        try:
            return self._values[quantity]
        except KeyError:
            value = self._values[quantity] = quantity.compute(self)
            return value

    def reference(self) -> Moment:
        """Return the same moment on the reference trajectory."""
        return self._owner.moment_of_reference(self.t)

    def remembered(self, quantity: Remembering) -> Any:
        """Return the value that a quantity with a memory had after the last step."""
        if not self.is_present:
            raise ConfigError(
                f"{quantity} looks back, which Reference cannot: give Reference to what it is of."
            )
        return self._owner.remembered(quantity)

    # What the simulation says --------------------------------------------------------------

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
        """Return the mass matrix of the robot that acts, shape (nv, nv)."""
        own = self.robot.velocities
        whole = self.simulation.positions() if self.is_present else self._state()[0]
        return self.simulation.mass_matrix(whole)[own, own]

    def contacts(self) -> Records:
        """Return the contacts of the last physics step.

        Raises:
            FeatureNotSupportedError: This is the moment of a trajectory, which has none.
        """
        if not self.is_present:
            raise FeatureNotSupportedError("A trajectory", "contacts", ())
        return self.simulation.contacts()

    def _state(self) -> tuple[Vector, Vector]:
        """Return positions and velocities of the whole world, with the robot's in their place."""
        if self._whole is None:
            positions, velocities = self.simulation.positions(), self.simulation.velocities()
            positions[self.robot.positions] = self.q
            velocities[self.robot.velocities] = self.v
            self._whole = positions, velocities
        return self._whole


class Quantities(Mapping[str, Any]):
    """The quantities of an environment, as `RobotEnv.quantities`.

    By name, those that were added: ``env.quantities["height"]`` is the value, computed when it is
    asked for. Without a name: ``env.quantities.get_value(BaseHeight())``.
    """

    def __init__(self, simulator: Simulator, step_dt: float) -> None:
        """Start without quantities.

        Args:
            simulator: The simulator of the environment.
            step_dt: Time of a step of the environment, in s.
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
            ConfigError: Another one has the name, or it is no quantity.
        """
        if not isinstance(quantity, Quantity):
            raise ConfigError(f'The quantity "{name}" is {quantity!r}, which is no Quantity.')
        if self._named.get(name, quantity) != quantity:
            raise ConfigError(f'There is another quantity "{name}": {self._named[name]}.')
        self._named[name] = quantity
        self.watch(quantity)

    def remove(self, name: str) -> None:
        """Forget a name.

        Raises:
            ComponentNotFoundError: There is no quantity of that name.
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
        """Go through the names."""
        return iter(self._named)

    def __len__(self) -> int:
        """Return how many have names."""
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
        """Return the present moment; it stays the same until the simulation goes on."""
        state = self.simulator.stepper_state
        if self._present is None or self._frame != state.iter:
            self._frame = state.iter
            self._present, self._on_reference = Moment(self, state.t, None), None
        return self._present

    def moment_of_reference(self, t: float) -> Moment:
        """Return the moment of the reference trajectory.

        Raises:
            ConfigError: There is none.
        """
        if self.trajectory is None:
            raise ConfigError(
                "A quantity asks for the reference, but there is no trajectory: give "
                "ComposedEnv(..., trajectory=...)."
            )
        if self._on_reference is None or self._on_reference.t != t:
            self._on_reference = Moment(self, t, self.trajectory.at(t))
        return self._on_reference

    def watch(self, quantity: Quantity) -> None:
        """Compute a quantity at the begin of each episode, so that its memories begin there."""
        self._watched.setdefault(quantity)

    def remembered(self, quantity: Remembering) -> Any:
        """Return the value of a quantity with a memory as of the last step."""
        if quantity not in self._memories:
            self._memories[quantity] = quantity.advance(None, self.moment())
        return self._memories[quantity][0]

    # Episodes -------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget all values and memories: an episode begins."""
        self._present = self._on_reference = None
        self._frame = -1
        self._memories, self._begins = {}, True

    def clear(self) -> None:
        """Forget the values, and let memories take up the step that was made.

        The first time after `reset` they begin, with the state that the episode begins with.
        """
        self._present = self._on_reference = None
        if self._begins:
            self._begins = False
            for watched in self._watched:
                self.get_value(watched)
        elif self._memories:
            moment = self.moment()
            # In the order in which they were met: what one is made of comes before it.
            for quantity, (_, memory) in [*self._memories.items()]:
                self._memories[quantity] = quantity.advance(memory, moment)

    def snapshot(self) -> Any:
        """Return what is remembered."""
        return [(quantity, copy_tree(kept)) for quantity, kept in self._memories.items()]

    def restore(self, state: Any) -> None:
        """Take up what `snapshot` returned."""
        self.reset()
        self._begins = False
        self._memories = {quantity: copy_tree(kept) for quantity, kept in state}


def check_quantity(where: str, value: Any) -> Quantity:
    """Return a value that is a quantity.

    Raises:
        ConfigError: It is none.
    """
    if not isinstance(value, Quantity):
        made = isinstance(value, type) and issubclass(value, Quantity)
        hint = f": make one, as in {value.__name__}(...)" if made else ""
        raise ConfigError(f"{where} is {value!r}, which is no Quantity{hint}.")
    return value


def as_array(value: Any) -> Vector:
    """Return a value as an array of floats."""
    return np.asarray(value, np.float64)
