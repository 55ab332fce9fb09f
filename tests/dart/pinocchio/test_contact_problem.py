"""Impulses of contacts and of rows with bounds against the conditions that define them."""

from __future__ import annotations

import numpy as np
import pytest

from physx_dart.pinocchio.contact_problem import ContactProblem
from physx_dart.pinocchio.solver import ImpulseSolver
from physx_sim.errors import SimulationError


def random_problem(rng, points, limits, bounded, spare):
    """Return a problem of some points and rows, of a body with few or many directions."""
    size = 3 * points + limits + bounded
    root = rng.normal(size=(size, size + spare))
    friction = rng.uniform(0.0, 1.0, points)
    strength = rng.exponential(size=bounded)
    least = np.concatenate([np.zeros(limits), -strength])
    most = np.concatenate([np.full(limits, np.inf), strength])
    return root @ root.T / size, root @ rng.normal(size=size + spare), friction, least, most


def check(problem, impulses, atol=1e-6):
    response, free, friction, least, most = problem
    velocities = response @ impulses + free
    k = len(friction)
    forces, speeds = impulses[: 3 * k].reshape(k, 3), velocities[: 3 * k].reshape(k, 3)
    assert (forces[:, 2] >= 0).all() and (speeds[:, 2] > -atol).all()
    assert np.abs(forces[:, 2] * speeds[:, 2]).max() < atol
    across, sliding = np.linalg.norm(forces[:, :2], axis=1), np.linalg.norm(speeds[:, :2], axis=1)
    bound = friction * forces[:, 2]
    assert (across < bound + atol).all()
    # What slides is braked with all that friction has, straight against its motion.
    power = (forces[:, :2] * speeds[:, :2]).sum(axis=1)
    np.testing.assert_allclose(power, -bound * sliding, atol=atol * (1 + bound.max()))
    rows, speeds = impulses[3 * k :], velocities[3 * k :]
    assert ((rows >= least) & (rows <= most)).all()
    assert (np.abs(speeds[(rows > least) & (rows < most)]) < atol).all()
    assert (speeds[rows == least] > -atol).all() and (speeds[rows == most] < atol).all()


@pytest.mark.parametrize("name", ["pgs", "admm"])
@pytest.mark.parametrize(
    ("points", "limits", "bounded"), [(1, 0, 0), (4, 0, 0), (3, 4, 0), (2, 0, 3), (4, 3, 2)]
)
def test_impulses_obey_coulombs_law_and_bounds(name, points, limits, bounded):
    rng, solver = np.random.default_rng(points), ImpulseSolver(name)
    for _ in range(30):
        problem = random_problem(rng, points, limits, bounded, spare=6)
        for guess in (np.zeros(len(problem[1])), rng.normal(size=len(problem[1]))):
            check(problem, solver.solve(*problem, guess))


@pytest.mark.parametrize("name", ["pgs", "admm"])
def test_a_plate_on_four_points_is_carried_even_if_newton_cycles(name):
    """More points than directions: many impulses do, and Newton's method alone goes in circles."""
    corners = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0], [0, 0, 0.0]])
    rows = [np.hstack([np.eye(3), -np.cross(np.eye(3), c)]) for c in corners]
    jacobian = np.concatenate(rows)
    response, solver = jacobian @ jacobian.T, ImpulseSolver(name)
    rng = np.random.default_rng(0)
    for _ in range(20):
        push = np.array([*rng.normal(size=2), -3.0, *rng.normal(size=3)])
        problem = response, jacobian @ push, np.full(5, 0.5), np.zeros(0), np.zeros(0)
        check(problem, solver.solve(*problem, np.zeros(15)))


def test_the_iterative_solvers_agree_with_newton():
    rng = np.random.default_rng(3)
    for name in ("pgs", "admm"):
        solver = ImpulseSolver(name)
        problem = ContactProblem(*random_problem(rng, 2, 3, 2, spare=20))
        best, error = problem.newton(np.zeros(11), 50)
        assert error < problem.accuracy
        iterate = solver.iterate(problem, name, (300, 1e-11), np.zeros(11))
        np.testing.assert_allclose(iterate, best, atol=1e-6)
        assert problem.error(iterate) < 1e-6


def test_values_that_are_not_finite_are_an_error():
    with pytest.raises(SimulationError, match="no longer finite"):
        ImpulseSolver("pgs").solve(
            np.eye(3), np.full(3, np.nan), np.ones(1), np.zeros(0), np.zeros(0), np.zeros(3)
        )


def test_directions_without_motion_get_no_impulse():
    """A cart on a rail, in the ground: its contacts can only be moved along the rail."""
    response, free = np.zeros((3, 3)), np.array([0.5, 0.0, -2.0])
    response[0, 0] = 1.0
    with np.errstate(all="raise"):
        problem = ContactProblem(response, free, np.array([1.0]), np.zeros(0), np.zeros(0))
        impulses, error = problem.newton(np.zeros(3), 10)
    np.testing.assert_array_equal(impulses, 0.0)
    assert error <= problem.accuracy


@pytest.mark.parametrize("name", ["pgs", "admm"])
def test_what_was_solved_before_changes_no_bit(name, monkeypatch):
    monkeypatch.setattr("physx_dart.pinocchio.solver._MOST_KNOWN", 3)
    rng, used = np.random.default_rng(8), ImpulseSolver(name)
    for number in range(40):
        problem = random_problem(rng, 1 + number % 3, number % 2, number % 5, spare=6)
        for guess in (np.zeros(len(problem[1])), rng.normal(size=len(problem[1]))):
            found = used.solve(*problem, guess)
            np.testing.assert_array_equal(found, ImpulseSolver(name).solve(*problem, guess))
