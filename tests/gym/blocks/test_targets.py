"""Targets never leave their bounds, and can always stop before them."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from physx_core.errors import ConfigError
from physx_gym.blocks import Targets

DT = 0.005


def targets(n=4, *, seed=0, period=DT):
    rng = np.random.default_rng(seed)
    lower = -rng.uniform(0.1, 3.0, n)
    upper = rng.uniform(0.1, 3.0, n)
    fastest, most = rng.uniform(0.5, 20.0, n), 10 ** rng.uniform(0.0, 4.0, n)
    made = Targets(lower, upper, fastest, most)
    made.set_period(period)
    made.start(rng.uniform(lower, upper), np.zeros(n))
    return made, lower, upper, fastest, most


@pytest.mark.slow
def test_fuzz_of_100_s_stays_within_all_bounds():
    n, steps = 32, 20_000
    made, lower, upper, fastest, most = targets(n)
    rng = np.random.default_rng(100)
    seen = np.empty((steps + 1, 2, n))
    seen[0] = made.pair
    for step in range(steps):
        if step % 40 == 0:  # hard against the bounds for a while, or anything
            wanted = most * rng.choice([-1.0, 0.0, 1.0], n)
            wanted += rng.normal(size=n) * most * rng.choice([0.0, 0.3])
            wanted = np.clip(wanted, -most, most)
        made.step(wanted)
        seen[step + 1] = made.pair
    q, v = seen[:, 0], seen[:, 1]
    assert (q >= lower - 1e-9).all()
    assert (q <= upper + 1e-9).all()
    assert (np.abs(v) <= fastest + 1e-9).all()
    assert (np.abs(np.diff(v, axis=0)) <= most * DT + 1e-9).all()
    np.testing.assert_allclose(np.diff(q, axis=0), v[1:] * DT, atol=1e-12)
    assert (np.abs(q - upper).min(0) < most * DT**2).all()  # it was there


def test_excessive_accelerations_never_lead_out_of_bounds():
    made, lower, upper, fastest, most = targets(8, seed=5)
    rng = np.random.default_rng(5)
    for _ in range(2000):
        made.step(1e3 * most * rng.normal(size=8))
        assert ((made.positions >= lower - 1e-9) & (made.positions <= upper + 1e-9)).all()
        assert (np.abs(made.velocities) <= fastest + 1e-9).all()


def test_targets_can_always_stop():
    n = 32
    made, lower, upper, _, most = targets(n, seed=1)
    rng = np.random.default_rng(1)
    for _ in range(60):
        wanted = most * rng.choice([-1.0, 1.0], n)
        for _ in range(int(rng.integers(1, 100))):
            made.step(wanted)
        q, v = made.positions.copy(), made.velocities.copy()
        # Nothing but full braking, without any bounds: the sum of falling velocities.
        periods = np.floor(np.abs(v) / (most * DT))
        far = DT * periods * (np.abs(v) - 0.5 * most * DT * (periods + 1))
        rest = q + np.sign(v) * far
        assert (rest >= lower - 1e-9).all()
        assert (rest <= upper + 1e-9).all()


@pytest.mark.slow
def test_rest_is_close_to_the_bound():
    made, _, upper, _, most = targets(5)
    for _ in range(20_000):
        made.step(most)
    assert (made.velocities == 0).all()
    gap = upper - made.positions
    assert (gap <= most * DT**2 / 8 + 1e-9).all()


def test_far_from_bounds_the_acceleration_is_followed():
    inf = np.full(2, np.inf)
    made = Targets(-inf, inf, inf, np.array([3.0, 5.0]))
    made.set_period(0.01)
    made.start(np.zeros(2), np.array([1.0, -1.0]))
    for _ in range(100):
        made.step(np.array([2.0, 5.0]))
    np.testing.assert_allclose(made.velocities, [3.0, 4.0], rtol=1e-12)
    np.testing.assert_allclose(made.positions, [1 + 1.01, -1 + 2.525], rtol=1e-12)


def test_the_start_is_clipped_to_the_bounds():
    made, lower, upper, _, _ = targets(4)
    made.start(upper + 1.0, np.full(4, 100.0))
    np.testing.assert_array_equal(made.positions, upper)
    assert (made.velocities < 1e-3).all()
    made.start(lower - 1.0, np.full(4, -100.0))
    np.testing.assert_array_equal(made.positions, lower)


def test_pickled_targets_continue_identically():
    made, _, _, _, most = targets()
    made.step(most)
    other = pickle.loads(pickle.dumps(made))  # noqa: S301
    for each in (made, other):
        each.step(0.3 * most)
    np.testing.assert_array_equal(other.pair, made.pair)
    assert np.shares_memory(other.positions, other.state)


@pytest.mark.parametrize(
    ("lower", "most", "message"),
    [
        (2.0, 1.0, "above the upper"),
        (-1.0, np.inf, "finite positive bounds"),
        (-1.0, 0.0, "finite positive bounds"),
    ],
)
def test_impossible_bounds(lower, most, message):
    one = np.ones(1)
    with pytest.raises(ConfigError, match=message):
        Targets(lower * one, one, one, most * one)
