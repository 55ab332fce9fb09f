"""State of the controlled robot and of the stepper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from physx_core.typing import Vector
from physx_gym.shared_arrays import SharedArrays
from physx_gym.simulator.equipment import Equipment
from physx_sim import Part, Simulation


@dataclass
class StepperState:
    """Progress of an episode.

    Attributes:
        t: Time since its start, in s.
        dt: Duration of a physics step, in s.
        iter: Physics steps since its start.
    """

    t: float = 0.0
    dt: float = 0.0
    iter: int = 0


class RobotState(SharedArrays):
    """State of the controlled robot; the arrays stay the same and are updated in place.

    Attributes:
        q: Positions, shape (nq,), in the convention of `Layout`.
        v: Velocities, shape (nv,).
        command: Torques commanded on the motors' shafts, shape (motors,), in N m or N.
    """

    _left_out: ClassVar[frozenset[str]] = frozenset({"_simulation", "_equipment"})

    def __init__(self, q: Vector, v: Vector, motors: int, stepper: StepperState) -> None:
        self.q, self.v = q, v
        # Adjacent in memory, as they are recorded together.
        self._a, self.command, self._torques = np.split(
            np.zeros(len(v) + 2 * motors), [len(v), len(v) + motors]
        )
        self._stepper, self._when = stepper, -1
        self._simulation: Simulation | None = None
        self._equipment: Equipment | None = None
        self._part, self._accelerates, self._alone = slice(0, len(v)), False, True

    def connect(self, simulation: Simulation, equipment: Equipment, part: Part) -> None:
        """Read accelerations and torques from a simulation from now on."""
        self._accelerates = "accelerations" in simulation.features
        self._simulation, self._equipment, self._part = simulation, equipment, part.velocities
        self._alone = simulation.layout.nv == len(self.v)
        self._when = -1

    def disconnect(self) -> None:
        """Keep the last values from now on."""
        self._simulation = self._equipment = None

    @property
    def a(self) -> Vector:
        """Accelerations in the last physics step, shape (nv,)."""
        self.refresh()
        return self._a

    @property
    def torques(self) -> Vector:
        """Torques on the motors' joints in the last physics step, shape (motors,), in N m or N."""
        self.refresh()
        return self._torques

    @property
    def u_motor(self) -> Vector:
        """The same as `torques`, under its name in Jiminy."""
        return self.torques

    def refresh(self) -> None:
        """Update `a` and `torques`."""
        simulation, equipment, frame = self._simulation, self._equipment, self._stepper.iter
        if self._when == frame or simulation is None or equipment is None:
            return
        self._when = frame
        if self._accelerates:
            found = simulation.accelerations()
            self._a[:] = found if self._alone else found[self._part]
        equipment.torques(self._torques)

    def expire(self) -> None:
        """Note that the simulation's state was set, not simulated."""
        self._when = -1

    def restore_memory(self, accelerations: Vector, torques: Vector) -> None:
        """Restore what engines do not keep in their snapshots."""
        self._when = self._stepper.iter
        self._a[:], self._torques[:] = accelerations, torques
