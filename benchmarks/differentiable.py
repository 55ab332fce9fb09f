"""Differentiable forward dynamics and steps.

Forward dynamics are measured against a loop of Pinocchio's own calls.

One unit of work is one state: its accelerations are computed, and a gradient is propagated back to
its positions, velocities and torques. The loop is written by hand: `pin.aba` forward, the
derivatives backward. Its gradients with respect to the positions are those of the tangent space;
physx goes one step further, to those with respect to the quaternion of the base. Times are wall
times; the claim is about two processes, which need two free processor cores.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio
import torch
from measure import claim, finish, rates, report

from physx_core import plugins
from physx_dart.pinocchio.algorithms import PinocchioAlgorithms
from physx_sim import Ground, Robot, World
from physx_torch import ForwardDynamics, Step

STATES, ROUNDS, REPEATS = 256, 25, 4
STEP_STATES = 8
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


def walked() -> tuple[Any, list[list[torch.Tensor]]]:
    """Return an ant on the ground and states of it, with commands, some in each."""
    world = World([Robot("ant", fixed_base=False)], ground=Ground(friction=0.8), period=5e-3)
    simulation, rng = plugins.resolve("backend", "pinocchio").build(world), np.random.default_rng(0)
    positions = simulation.positions()
    positions[2] = 0.6
    simulation.set_state(positions, np.zeros(simulation.layout.nv))
    found = []
    for step in range(200 + 20 * STEP_STATES):
        simulation.set_commands(rng.uniform(-1.0, 1.0, 8))
        simulation.step()
        if step >= 200 and step % 20 == 0:
            q = simulation.positions()
            q[2] -= 2e-4  # where all that touches is a little inside: away from switches
            state = q, simulation.velocities(), rng.uniform(-1.0, 1.0, 8)
            found.append([torch.tensor(values, requires_grad=True) for values in state])
    return simulation, found


def error(step: Step, state: list[torch.Tensor]) -> float:
    """Return the error of gradients, relative to the largest of the central differences."""

    def after(*rows: torch.Tensor) -> torch.Tensor:
        return torch.cat(step(*rows))

    found = torch.cat(torch.autograd.functional.jacobian(after, tuple(state)), dim=1)
    columns, size = [], 1e-6
    for place, values in enumerate(state):
        for unit in torch.eye(len(values), dtype=torch.float64):
            two = []
            for sign in (-1.0, 1.0):
                moved = [each.detach() for each in state]
                moved[place] = moved[place] + sign * size * unit
                two.append(after(*moved))
            columns.append((two[1] - two[0]) / (2 * size))
    wanted = torch.stack(columns, dim=1)
    return float((found - wanted).abs().max() / wanted.abs().max())


def steps() -> list[bool]:
    """Measure steps of an ant on the ground."""
    simulation, states = walked()
    rng, step = np.random.default_rng(1), Step(simulation)
    weights = [torch.tensor(rng.normal(size=len(each))) for each in states[0][:2]]

    def forward() -> int:
        with torch.no_grad():
            for state in states:
                step(*state)
        return len(states)

    def both() -> int:
        for state in states:
            torch.autograd.grad(step(*state), state, weights)
        return len(states)

    measured = rates({"forward": forward, "forward and backward": both}, ROUNDS)
    report("Steps of an ant on the ground, with contacts", "steps", measured, "forward", 0.25)
    pairs = zip(measured["forward"], measured["forward and backward"], strict=True)
    met = [
        claim(
            "backward, relative to forward",
            statistics.median(alone / with_it - 1 for alone, with_it in pairs),
            at_most=3.0,
        )
    ]
    for many, most in ((1, 1e-6), (32, 1e-5)):
        errors = [error(Step(simulation, many), state) for state in states]
        told = f"error of gradients of {many} step(s), median of {len(states)} states"
        met.append(claim(told, statistics.median(errors), at_most=most))
        print(f"    largest: {max(errors):.1e}\n")
    simulation.close()
    return met


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
    finish([met, *steps()])


if __name__ == "__main__":
    main()
