"""Checks of the dynamics of any state."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from physx_core.typing import Vector
from physx_sim import Simulation
from physx_sim.conformance.worlds import arm, build, need, state_of
from physx_testing.subject import Check, Subject, expect, expect_close

_SMALL = 1e-6


def _both(subject: Subject) -> Iterator[Simulation]:
    for fixed in (True, False):
        with build(subject, arm(robot={"fixed_base": fixed})) as simulation:
            yield simulation


def _torques(simulation: Simulation, seed: int) -> Vector:
    return np.random.default_rng([seed, 1]).standard_normal(simulation.layout.nv)


def _agree(subject: Subject) -> None:
    need(subject, "inverse_dynamics")
    need(subject, "forward_dynamics")
    for simulation in _both(subject):
        for seed in range(5):
            q, v = state_of(simulation, seed)
            torques = _torques(simulation, seed)
            before = simulation.positions().copy()
            rates = simulation.forward_dynamics(q, v, torques)
            expect_close(
                simulation.inverse_dynamics(q, v, rates),
                torques,
                1e-7,
                "inverse_dynamics() does not recover the torques of forward_dynamics(): off",
            )
            expect(np.array_equal(simulation.positions(), before), "the dynamics changed the state")


def _mass(subject: Subject) -> None:
    need(subject, "mass_matrix")
    for simulation in _both(subject):
        q, v = state_of(simulation, 1)
        matrix = simulation.mass_matrix(q)
        expect_close(matrix, matrix.T, 1e-10, "the mass matrix is not symmetric")
        expect(np.linalg.eigvalsh(matrix).min() > 0, "the mass matrix is not positive definite")
        columns = [
            simulation.inverse_dynamics(q, v, unit) - simulation.inverse_dynamics(q, v, 0 * unit)
            for unit in np.eye(simulation.layout.nv)
        ]
        expect_close(
            np.array(columns).T, matrix, 1e-8, "mass_matrix() and inverse_dynamics() differ"
        )


def _jacobian(subject: Subject) -> None:
    need(subject, "jacobian")
    for simulation in _both(subject):
        q, v = state_of(simulation, 2)
        matrix = simulation.jacobian("hand", q)
        (wanted,) = simulation.body_velocities(["hand"], q, v)
        expect_close(
            matrix @ v, wanted, 1e-8, "jacobian() times the velocities and body_velocities() differ"
        )
    with build(subject, arm()) as simulation:  # its velocities are derivatives of its positions
        q, v = state_of(simulation, 3)
        (before,), (after,) = (
            simulation.body_poses(["hand"], q + sign * _SMALL * v) for sign in (-1, 1)
        )
        (velocity,) = simulation.body_velocities(["hand"], q, v)
        expect_close(
            velocity[:3],
            (after - before)[:3] / (2 * _SMALL),
            1e-6,
            "body_velocities() are not the derivatives of body_poses()",
        )


def _derivatives(subject: Subject) -> None:
    need(subject, "derivatives")
    with build(subject, arm()) as simulation:
        q, v = state_of(simulation, 4)
        state = [q, v, _torques(simulation, 4)]
        found = simulation.forward_dynamics_derivatives(q, v, state[2])
        for number, name in enumerate(("positions", "velocities", "torques")):
            columns = []
            for unit in np.eye(simulation.layout.nv):
                two = []
                for sign in (-1, 1):
                    moved = list(state)
                    moved[number] = moved[number] + sign * _SMALL * unit
                    two.append(simulation.forward_dynamics(moved[0], moved[1], moved[2]))
                columns.append((two[1] - two[0]) / (2 * _SMALL))
            expect_close(
                found[number],
                np.array(columns).T,
                1e-5,
                f"the derivatives w.r.t. {name} differ from finite differences",
            )


def _step_derivatives(subject: Subject) -> None:
    need(subject, "step_derivatives")
    with build(subject, arm()) as simulation:
        q, v = state_of(simulation, 4)
        state = [q, v, _torques(simulation, 4)]

        def stepped(*given: Vector) -> Vector:
            simulation.set_state(given[0], given[1])
            simulation.set_torques(given[2])
            simulation.step(2)
            return np.concatenate([simulation.positions(), simulation.velocities()])

        columns = []
        for number, width in enumerate(map(len, state)):
            for unit in np.eye(width):
                two = []
                for sign in (-1, 1):
                    moved = list(state)
                    moved[number] = moved[number] + sign * _SMALL * unit
                    two.append(stepped(*moved))
                columns.append((two[1] - two[0]) / (2 * _SMALL))
        simulation.set_state(q, v)
        simulation.set_torques(state[2])
        found = simulation.step_with_derivatives(2)
        expect_close(
            np.hstack([found.state, found.commands]),
            np.array(columns).T,
            1e-5,
            "the derivatives of steps differ from finite differences",
        )


def _batches(subject: Subject) -> None:
    need(subject, "forward_dynamics")
    for simulation in _both(subject):
        states = [state_of(simulation, seed) for seed in range(4)]
        q, v = (np.array(rows) for rows in zip(*states, strict=True))
        torques = np.array([_torques(simulation, seed) for seed in range(4)])
        single = [simulation.forward_dynamics(*row) for row in zip(q, v, torques, strict=True)]
        expect_close(
            simulation.forward_dynamics_batch(q, v, torques),
            np.array(single),
            1e-9,
            "forward_dynamics_batch() and forward_dynamics() differ",
        )


CHECKS: dict[str, Check] = {
    "has forward and inverse dynamics that agree": _agree,
    "has a mass matrix that agrees with the dynamics": _mass,
    "has Jacobians that agree with velocities": _jacobian,
    "has derivatives that agree with finite differences": _derivatives,
    "has derivatives of steps that agree with finite differences": _step_derivatives,
    "computes batches like single states": _batches,
}
