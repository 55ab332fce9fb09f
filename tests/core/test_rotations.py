"""Rotations: each form against another way to compute the same."""

from __future__ import annotations

import numpy as np
import pytest

from physx_core import rotations


def quaternions(n=50, seed=0):
    q = np.random.default_rng(seed).normal(size=(n, 4))
    q *= np.sign(q[:, 3:])
    return q / np.linalg.norm(q, axis=1, keepdims=True)


VECTORS = np.random.default_rng(1).normal(size=(50, 3))


def test_quaternions_rotate_like_their_matrices():
    q = quaternions()
    matrices = rotations.to_matrix_rows(q)
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0)
    expected = np.einsum("nij,nj->ni", matrices, VECTORS)
    np.testing.assert_allclose(rotations.rotate_rows(q, VECTORS), expected, atol=1e-12)
    np.testing.assert_allclose(rotations.rotate_back_rows(q, expected), VECTORS, atol=1e-12)
    np.testing.assert_allclose(rotations.from_matrix_rows(matrices), q, atol=1e-12)
    product = rotations.to_matrix_rows(rotations.multiply_rows(q, q[::-1]))
    np.testing.assert_allclose(product, matrices @ matrices[::-1], atol=1e-12)
    inverse = rotations.to_matrix_rows(rotations.invert_rows(q))
    np.testing.assert_allclose(inverse, np.swapaxes(matrices, 1, 2), atol=1e-12)


def test_the_forms_for_one_and_for_many_agree():
    q, plain = quaternions(), [tuple(row) for row in quaternions().tolist()]
    vectors = VECTORS.tolist()
    for many, one in (
        (rotations.cross_rows(q[:, :3], VECTORS),
         [rotations.cross(*a[:3], *v) for a, v in zip(plain, vectors, strict=True)]),
        (rotations.rotate_rows(q, VECTORS),
         [rotations.rotate(a, *v) for a, v in zip(plain, vectors, strict=True)]),
        (rotations.rotate_back_rows(q, VECTORS),
         [rotations.rotate_back(a, *v) for a, v in zip(plain, vectors, strict=True)]),
        (rotations.multiply_rows(q, q[::-1]),
         [rotations.multiply(a, b) for a, b in zip(plain, plain[::-1], strict=True)]),
        (rotations.invert_rows(q), [rotations.invert(a) for a in plain]),
        (rotations.from_rotation_vector_rows(0.5 * VECTORS),
         [rotations.from_rotation_vector(*v) for v in (0.5 * VECTORS).tolist()]),
        (rotations.to_rotation_vector_rows(q), [rotations.to_rotation_vector(a) for a in q]),
        (rotations.to_roll_pitch_yaw_rows(q), [rotations.to_roll_pitch_yaw(a) for a in plain]),
        (rotations.to_matrix_rows(q), [rotations.to_matrix(a) for a in plain]),
    ):  # fmt: skip
        np.testing.assert_allclose(many, one, atol=1e-12)


def test_conversions_are_inverse_to_each_other():
    for q in quaternions():
        vector = rotations.to_rotation_vector(q)
        np.testing.assert_allclose(rotations.from_rotation_vector(*vector), q, atol=1e-12)
        length = float(np.linalg.norm(vector))
        turn = rotations.from_axis_angle(vector / length, length)
        np.testing.assert_allclose(turn, q, atol=1e-12)
        angles = rotations.to_roll_pitch_yaw(q)
        found = np.array(rotations.from_roll_pitch_yaw(*angles))
        np.testing.assert_allclose(found * np.sign(found[3]), q, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9])
def test_small_rotations_are_exact(angle):
    q = rotations.from_rotation_vector(angle, 0.0, 0.0)
    assert q == (0.5 * angle, 0.0, 0.0, 1.0)
    assert rotations.to_rotation_vector(np.array(q)).tolist() == [angle, 0.0, 0.0]


def test_interpolation_takes_the_short_way_at_an_even_pace():
    first = np.array([rotations.from_axis_angle((0, 0, 1), 0.1)])
    second = -np.array([rotations.from_axis_angle((0, 0, 1), 0.3)])
    middle = rotations.interpolate_rows(first, second, np.array([[0.5]]))
    expected = rotations.from_axis_angle((0, 0, 1), 0.2)
    np.testing.assert_allclose(middle[0], expected, atol=1e-12)
