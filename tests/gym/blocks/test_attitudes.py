"""The filter's mathematics, compared with rotations that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core.rotations import (
    from_rotation_vector_rows,
    multiply_rows,
    rotate_back_rows,
    rotate_rows,
    to_roll_pitch_yaw,
)
from physx_gym.blocks import mahony

DT = 0.005
UP = np.array([0.0, 0.0, 1.0])


def quaternions(n, seed=0):
    q = np.random.default_rng(seed).normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def angle(a, b):
    dot = np.abs(np.sum(a * b, axis=-1))
    return 2 * np.arccos(np.minimum(dot, 1.0))


def test_the_scalar_and_the_array_form_agree():
    rng = np.random.default_rng(1)
    states = np.concatenate([quaternions(5), rng.normal(size=(5, 9))], axis=1)
    measured = np.concatenate([rng.normal(size=(5, 3)), 6 * rng.normal(size=(5, 3))], axis=1)
    measured[3, 3:] *= 9.81 / np.linalg.norm(measured[3, 3:])
    measured[4, 3:] = 0.0  # weightless
    for _ in range(20):
        alone = [
            mahony.advance(row.tolist(), seen.tolist(), mahony.Gains.of(1.3, 0.2, DT, 9.81))
            for row, seen in zip(states, measured, strict=True)
        ]
        states = mahony.advance_rows(states, measured, mahony.Gains.of(1.3, 0.2, DT, 9.81))
        np.testing.assert_allclose(states, alone, rtol=0, atol=1e-13)


def test_follows_a_rotation_exactly_without_gains():
    rate = np.array([0.7, -1.1, 0.4])
    begin = quaternions(1)[0]
    state = [*begin, *rate, 0, 0, 0, *rate]
    for _ in range(400):
        state = mahony.advance(state, [*rate, 0, 0, 0], mahony.Gains.of(0.0, 0.0, DT, 9.81))
    end = multiply_rows(begin, from_rotation_vector_rows(400 * DT * rate))
    assert angle(end, np.array(state[:4])) < 1e-7


def test_fast_rotations_are_exact_too():
    rate = np.array([150.0, -200.0, 90.0])
    state = mahony.advance(
        [0, 0, 0, 1.0, *rate, 0, 0, 0, *rate], [*rate, 0, 0, 0], mahony.Gains.of(0, 0, DT, 9.81)
    )
    assert angle(from_rotation_vector_rows(DT * rate), np.array(state[:4])) < 1e-7


@pytest.mark.slow
def test_finds_up_and_bias_from_acceleration():
    truth = quaternions(1, seed=3)[0]
    seen = 9.81 * rotate_back_rows(truth, UP)
    bias = np.array([0.02, -0.01, 0.03])
    state = [0.0, 0.0, 0.0, 1.0, *bias, 0, 0, 0, *bias]
    for _ in range(int(120 / DT)):
        state = mahony.advance(state, [*bias, *seen], mahony.Gains.of(1.0, 0.1, DT, 9.81))
    found = rotate_back_rows(np.array(state[:4]), UP)
    np.testing.assert_allclose(found, seen / 9.81, atol=1e-3)
    across = bias - np.dot(bias, found) * found  # a bias about the vertical cannot be seen
    estimate = np.array(state[7:10])
    np.testing.assert_allclose(estimate - np.dot(estimate, found) * found, across, atol=1e-3)


@pytest.mark.parametrize(("size", "share"), [(1.0, 1.0), (1.1, 0.58), (0.9, 0.62), (1.3, 0.0)])
def test_accelerations_are_weighted_by_how_close_to_gravity_they_are(size, share):
    still = [0.0, 0.0, 0.0, 1.0, *[0.0] * 9]
    seen = 9.81 * np.array([0.1, 0.0, 0.99**0.5])
    moved = mahony.advance(still, [0, 0, 0, *(size * seen)], mahony.Gains.of(1.0, 0, DT, 9.81))
    full = mahony.advance(still, [0, 0, 0, *seen], mahony.Gains.of(1.0, 0, DT, 9.81))
    assert abs(moved[1] / full[1] - share) < 1e-3
    np.testing.assert_allclose(full[1], -0.5 * DT * 0.1, rtol=1e-3)


def test_the_attitude_from_gravity_has_no_twist():
    for truth in quaternions(20):
        found = np.array(mahony.attitude_from_gravity(*(9.81 * rotate_back_rows(truth, UP))))
        np.testing.assert_allclose(
            rotate_back_rows(found, UP), rotate_back_rows(truth, UP), atol=1e-12
        )
        assert found[2] == 0.0
    assert mahony.attitude_from_gravity(0.0, 0.0, -9.81) == (1.0, 0.0, 0.0, 0.0)
    assert mahony.attitude_from_gravity(0.0, 0.0, 0.0) == (0.0, 0.0, 0.0, 1.0)


def test_removing_the_twist_keeps_up():
    for truth in quaternions(20):
        found = np.array(mahony.remove_twist(*truth))
        np.testing.assert_allclose(np.linalg.norm(found), 1.0)
        np.testing.assert_allclose(
            rotate_back_rows(found, UP), rotate_back_rows(truth, UP), atol=1e-12
        )
        np.testing.assert_allclose(found[2], 0.0, atol=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_roll_pitch_yaw(seed):
    roll, pitch, yaw = np.random.default_rng(seed).uniform(-1.4, 1.4, 3)
    turns = from_rotation_vector_rows(np.diag([roll, pitch, yaw]))
    whole = multiply_rows(turns[2], multiply_rows(turns[1], turns[0]))
    np.testing.assert_allclose(to_roll_pitch_yaw(whole), [roll, pitch, yaw], atol=1e-12)
    np.testing.assert_allclose(
        rotate_rows(whole, UP),
        rotate_rows(turns[2], rotate_rows(turns[1], rotate_rows(turns[0], UP))),
        atol=1e-12,
    )
