"""ForwardDynamics: the forward dynamics of a simulation as a differentiable function."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from physx_core.typing import Vector
from physx_sim import Simulation
from physx_sim.errors import FeatureNotSupportedError, SimulationError
from physx_torch.coordinates import as_rows, to_position_gradients


class ForwardDynamics:
    """Accelerations as a function of positions, velocities and torques, with gradients.

    Values are those of `Simulation.forward_dynamics`, with damping, springs and Coulomb friction
    but without contacts and limits. Gradients are computed from analytic derivatives in double
    precision on the CPU, with constant Coulomb friction. The quaternion of a floating base is
    normalized, and its gradient is with respect to the normalized one. There are no second
    derivatives.

    Example:
        >>> dynamics = ForwardDynamics(simulation, processes=2)
        >>> loss = (dynamics(q, v, network(q, v)) - wanted).square().mean()

    Args:
        simulation: Simulation of any engine with the feature ``derivatives``; its state is neither
            used nor changed. It must stay open.
        processes: Largest number of processes that share a batch of states, including this one.
            The others start with the first sufficiently large batch and end with the simulation.

    Raises:
        FeatureNotSupportedError: If the simulation has no derivatives of its forward dynamics.
        SimulationError: If the number of processes is not an integer of at least 1.
    """

    def __init__(self, simulation: Simulation, processes: int = 1) -> None:
        if "derivatives" not in simulation.features:
            raise FeatureNotSupportedError(simulation.engine, "derivatives", simulation.features)
        if not isinstance(processes, int) or processes < 1:
            raise SimulationError(
                f"processes is {processes!r} but must be an integer of at least 1."
            )
        self.simulation, self.processes = simulation, processes

    def __call__(self, positions: Tensor, velocities: Tensor, torques: Tensor) -> Tensor:
        """Return the accelerations, shape (..., nv), with the dtype and device of the input.

        Args:
            positions: Shape (..., nq), in the convention of `physx_sim.layout`.
            velocities: Shape (..., nv).
            torques: Shape (..., nv), in N m or N; a floating base's first six are a force and a
                torque on it, along its own axes. The leading axes of all three are broadcast.

        Raises:
            SimulationError: If a shape does not match, a value is not finite, a quaternion does not
                have length 1 (within 0.001), or one of the processes has ended.
        """
        given, layout = (positions, velocities, torques), self.simulation.layout
        names, widths = ("positions", "velocities", "torques"), (layout.nq, layout.nv, layout.nv)
        rows, leading, dtype = as_rows(names, given, widths)
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in given):
            found: Tensor = _Function.apply(self, *rows)
        else:
            found = torch.from_numpy(_accelerations(self, rows))
        return found.reshape(*leading, velocities.shape[-1]).to(positions.device, dtype)


def _accelerations(dynamics: ForwardDynamics, rows: Sequence[Tensor]) -> Vector:
    arrays = [row.detach().numpy() for row in rows]
    return dynamics.simulation.forward_dynamics_batch(*arrays, processes=dynamics.processes)


class _Function(torch.autograd.Function):
    """Forward dynamics of states given as rows."""

    @staticmethod
    def forward(ctx: Any, dynamics: ForwardDynamics, *rows: Tensor) -> Tensor:
        accelerations = torch.from_numpy(_accelerations(dynamics, rows))
        ctx.dynamics = dynamics
        ctx.save_for_backward(*rows[:2], accelerations)
        return accelerations

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor | None, ...]:
        simulation, processes = ctx.dynamics.simulation, ctx.dynamics.processes
        arrays = [tensor.detach().numpy() for tensor in (*ctx.saved_tensors, given)]
        gradients = list(simulation.forward_dynamics_gradients_batch(*arrays, processes=processes))
        if ctx.needs_input_grad[1]:
            gradients[0] = to_position_gradients(simulation.layout, arrays[0], gradients[0])
        needed = zip(gradients, ctx.needs_input_grad[1:], strict=True)
        return None, *(torch.from_numpy(each) if needs else None for each, needs in needed)
