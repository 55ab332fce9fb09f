"""Differentiable forward dynamics against a loop of Pinocchio's own calls.

One unit of work is one state: its accelerations are computed, and a gradient is propagated back to
its positions, velocities and torques. The loop is written by hand: `pin.aba` forward, the
derivatives backward. Its gradients with respect to the positions are those of the tangent space;
physx goes one step further, to those with respect to the quaternion of the base. Times are wall
times; the claim is about two processes, which need two free processor cores.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio
import torch
from measure import finish, rates, report

from physx_core import plugins
from physx_dart.pinocchio.algorithms import PinocchioAlgorithms
from physx_sim import Robot, World
from physx_torch import ForwardDynamics

STATES, ROUNDS, REPEATS = 256, 25, 4
SHARED = "physx, 2 processes"


class Loop(torch.autograd.Function):
    """Forward dynamics state by state, with gradients in the tangent space."""

    @staticmethod
    def forward(ctx: Any, model: Any, *rows: torch.Tensor) -> torch.Tensor:
        """Return the accelerations."""
        data = model.createData()
        ctx.model = model
        ctx.save_for_backward(*rows)
        states = zip(*(row.numpy() for row in rows), strict=True)
        return torch.from_numpy(
            np.array([pinocchio.aba(model, data, q, v, tau) for q, v, tau in states])
        )

    @staticmethod
    def backward(ctx: Any, given: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Return the gradients."""
        model, data = ctx.model, ctx.model.createData()
        states = zip(*(row.numpy() for row in ctx.saved_tensors), strict=True)
        found = np.empty((3, *given.shape, model.nv))
        for i, (q, v, tau) in enumerate(states):
            found[0, i], found[1, i], found[2, i] = pinocchio.computeABADerivatives(
                model, data, q, v, tau
            )
        return gradients(torch.from_numpy(found), given)


def gradients(found: torch.Tensor, given: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    """Return gradients from derivatives; those of the positions are as wide as the positions."""
    by_q, by_v, by_tau = (given[:, None] @ matrices for matrices in found)
    by_q = torch.cat([by_q[:, 0], torch.zeros(len(given), 1)], dim=1)
    return None, by_q, by_v[:, 0], by_tau[:, 0]


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    world = World([Robot("a1/a1", fixed_base=False)])
    simulation = plugins.resolve("backend", "pinocchio").build(world)
    model = PinocchioAlgorithms.of(world).movables[0].model
    rng = np.random.default_rng(0)
    neutral, moves = pinocchio.neutral(model), rng.normal(size=(STATES, model.nv))
    drawn = [pinocchio.integrate(model, neutral, move) for move in moves]
    speeds, torques = rng.normal(size=(2, STATES, model.nv))
    states = [torch.tensor(x, requires_grad=True) for x in (np.array(drawn), speeds, torques)]
    weights = torch.tensor(rng.normal(size=(STATES, model.nv)))

    def through(function: Callable[..., torch.Tensor], *first: Any) -> Callable[[], int]:
        def work() -> int:
            for _ in range(REPEATS):
                torch.autograd.grad(function(*first, *states), states, weights)
            return REPEATS * STATES

        return work

    measured = rates(
        {
            "loop of aba and derivatives": through(Loop.apply, model),
            "physx": through(ForwardDynamics(simulation)),
            SHARED: through(ForwardDynamics(simulation, processes=2)),
        },
        ROUNDS,
    )
    heading = f"Forward dynamics with gradients: batch of {STATES}, {model.nv} degrees of freedom"
    met = report(heading, "states", measured, "loop of aba and derivatives", 1.5, SHARED)
    simulation.close()
    finish([met])


if __name__ == "__main__":
    main()
