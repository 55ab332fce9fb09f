"""Derivatives of steps of a simulation."""

from __future__ import annotations

from dataclasses import dataclass

from physx_core.typing import Vector


@dataclass(frozen=True, eq=False)
class StepDerivatives:
    """How the state after some physics steps depends on that before and on the held commands.

    Changes of positions are small motions in velocity space, so a base has six, along and about
    its own axes. Rows are changes of positions, then of velocities, after the steps.

    Attributes:
        state: Columns are changes of positions, then of velocities, before, shape (2 nv, 2 nv).
        commands: Columns are changes of the held commands, shape (2 nv, joints).
        asymmetry: Difference between the changes of the velocities after the steps for a small
            change of those before, and for its opposite, relative to their mean: near 0 where the
            steps are smooth, of the order of 1 at a switch, such as from sticking to sliding, where
            the derivatives are those of one side. None if they were not compared.
    """

    state: Vector
    commands: Vector
    asymmetry: float | None = None

    def after(self, earlier: StepDerivatives) -> StepDerivatives:
        """Return the derivatives of steps that follow earlier ones under the same commands."""
        commands = self.state @ earlier.commands + self.commands
        return StepDerivatives(self.state @ earlier.state, commands, self.asymmetry)
