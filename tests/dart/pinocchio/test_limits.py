"""The solver of limits and friction against the conditions that define its solution."""

from __future__ import annotations

import numpy as np
import pytest

from physx_dart.pinocchio.limits import solve


@pytest.mark.parametrize("n", [1, 2, 5, 20])
def test_impulses_are_within_bounds_and_complementary(n):
    rng = np.random.default_rng(n)
    for _ in range(100):
        root = rng.normal(size=(n, n))
        response = root @ root.T + 1e-2 * np.eye(n)
        change = rng.normal(size=n) * 3
        least, most = -rng.exponential(size=n), rng.exponential(size=n)
        kind = rng.integers(3, size=n)
        least, most = np.where(kind == 1, 0, least), np.where(kind == 1, np.inf, most)
        least, most = np.where(kind == 2, -np.inf, least), np.where(kind == 2, 0, most)
        impulses = solve(response, change, least, most)
        missing = response @ impulses - change
        assert ((impulses >= least) & (impulses <= most)).all()
        scale = 1e-6 * (1 + np.abs(response).max() * np.abs(impulses).max())
        assert (np.abs(missing[(impulses > least) & (impulses < most)]) < scale).all()
        assert (missing[impulses == least] > -scale).all()
        assert (missing[impulses == most] < scale).all()


def test_a_joint_with_limit_and_friction_has_two_rows():
    response, bound = np.ones((2, 2)), np.array([np.inf, 0.25])
    impulses = solve(response, np.array([1.0, 1.0]), np.array([0.0, -0.25]), bound)
    np.testing.assert_allclose(impulses.sum(), 1.0, rtol=1e-6)
