"""Step: steps of a simulation, contacts included, as a differentiable function."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from physx_core.typing import Vector
from physx_sim import Simulation
from physx_sim.errors import FeatureNotSupportedError, SimulationError
from physx_torch.coordinates import (
    as_rows,
    to_motion_gradients,
    to_position_gradients,
)


class Step:
    """The state after physics steps as a function of that before and of commands, with gradients.

    Values are those of `Simulation.step`, from a cold start of its solver, with contacts, limits,
    friction and motors. Gradients are exact derivatives of the steps, in double precision on the
    CPU: see `Simulation.step_with_derivatives`. At a switch, such as from sticking to sliding, they
    are those of one side. The quaternion of a floating base is normalized, and its gradient is with
    respect to the normalized one; commands beyond their limits have none. There are no second
    derivatives.

    Example:
        >>> step = Step(simulation, steps=10)
        >>> for _ in range(20):
        ...     q, v = step(q, v, policy(q, v))
        >>> (q - wanted).square().sum().backward()

    Args:
        simulation: Simulation of an engine with the feature ``step_derivatives``. It must stay
            open; its state is that after the last step of the last row.
        steps: Number of physics steps under the same commands.
        compare_sides: Whether each call that needs gradients sets `asymmetry`; it then takes three
            times as many steps.

    Attributes:
        asymmetry: `StepDerivatives.asymmetry` of each state in the last such call, shape (...); of
            the order of 1 at a switch. None before.

    Raises:
        FeatureNotSupportedError: If the simulation has no derivatives of steps.
        SimulationError: If the number of steps is not an integer of at least 1.
    """

    def __init__(
        self, simulation: Simulation, steps: int = 1, *, compare_sides: bool = False
    ) -> None:
        if "step_derivatives" not in simulation.features:
            raise FeatureNotSupportedError(
                simulation.engine, "step_derivatives", simulation.features
            )
        if not isinstance(steps, int) or steps < 1:
            raise SimulationError(f"steps is {steps!r} but must be an integer of at least 1.")
        self.simulation, self.steps, self.compare_sides = simulation, steps, compare_sides
        self.asymmetry: Tensor | None = None

    def __call__(
        self, positions: Tensor, velocities: Tensor, commands: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return positions and velocities after the steps, with the dtype and device of the input.

        Args:
            positions: Shape (..., nq), in the convention of `physx_sim.layout`.
            velocities: Shape (..., nv).
            commands: Held during the steps, as in `Simulation.set_commands`, shape (..., joints).
                The leading axes of all three are broadcast.

        Raises:
            SimulationError: If a shape does not match, a value is not finite, or gradients are
                needed and a step has none; the message names the reason.
        """
        given, layout = (positions, velocities, commands), self.simulation.layout
        widths = layout.nq, layout.nv, len(layout.joints)
        names = ("positions", "velocities", "commands")
        rows, leading, dtype = as_rows(names, given, widths)
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in given):
            q, v, asymmetry = _Function.apply(self, *rows)
            self.asymmetry = asymmetry.reshape(leading) if self.compare_sides else None
        else:
            q, v = (torch.from_numpy(array) for array in self._run(rows, None))
        device = positions.device
        return (
            q.reshape(*leading, layout.nq).to(device, dtype),
            v.reshape(*leading, layout.nv).to(device, dtype),
        )

    def _run(self, rows: Sequence[Tensor], slopes: list[Any] | None) -> tuple[Vector, Vector]:
        """Return positions and velocities after the steps, and append their derivatives."""
        simulation = self.simulation
        arrays = [row.detach().numpy() for row in rows]
        q, v = np.empty(arrays[0].shape), np.empty(arrays[1].shape)
        for place, (positions, velocities, commands) in enumerate(zip(*arrays, strict=True)):
            simulation.set_state(positions, velocities)
            simulation.set_commands(commands)
            if slopes is None:
                simulation.step(self.steps)
            else:
                found = simulation.step_with_derivatives(
                    self.steps, compare_sides=self.compare_sides
                )
                held = simulation.commands() == commands
                slopes.append((found.state, found.commands * held, found.asymmetry or 0.0))
            simulation.positions(out=q[place])
            simulation.velocities(out=v[place])
        return q, v


class _Function(torch.autograd.Function):
    """Steps from states given as rows."""

    @staticmethod
    def forward(ctx: Any, step: Step, *rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        slopes: list[Any] = []
        q, v = step._run(rows, slopes)
        n, width, joints = len(v), 2 * v.shape[1], rows[2].shape[1]
        state, commands, asymmetry = zip(*slopes, strict=True) if slopes else ((), (), ())
        ctx.layout = step.simulation.layout
        ctx.slopes = (
            np.array(state).reshape(n, width, width),
            np.array(commands).reshape(n, width, joints),
        )
        after = torch.from_numpy(q)
        ctx.save_for_backward(rows[0], after)
        sides = torch.tensor(asymmetry, dtype=torch.float64)
        ctx.mark_non_differentiable(sides)
        return after, torch.from_numpy(v), sides

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_q: Tensor, by_v: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        before, after = (tensor.detach().numpy() for tensor in ctx.saved_tensors)
        moved = to_motion_gradients(ctx.layout, after, by_q.numpy())
        weights, nv = np.concatenate([moved, by_v.numpy()], axis=1)[:, None], ctx.layout.nv
        state, commands = ((weights @ slopes)[:, 0] for slopes in ctx.slopes)
        to_positions = to_position_gradients(ctx.layout, before, state[:, :nv])
        gradients = to_positions, state[:, nv:], commands
        needed = zip(gradients, ctx.needs_input_grad[1:], strict=True)
        return None, *(torch.from_numpy(each) if needs else None for each, needs in needed)
