"""Maps between meshes and grids, voxels and visible points, against independent formulas."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from physx_core.errors import ConfigError
from physx_core.geometry import barycentric_map, trilinear_map, visible, voxelize

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
SIDES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip
"""Triangles of a cube."""


def ball(count=400):
    """Return nodes and triangles of a sphere of radius 1."""
    hull = pytest.importorskip("scipy.spatial").ConvexHull
    place = np.arange(count) + 0.5
    height, turn = 1 - 2 * place / count, np.pi * (1 + 5**0.5) * place
    around = np.sqrt(1 - height**2)
    nodes = np.stack([around * np.cos(turn), around * np.sin(turn), height], 1)
    triangles = hull(nodes).simplices
    normals = np.cross(*(nodes[triangles[:, k]] - nodes[triangles[:, 0]] for k in (1, 2)))
    inward = (normals * nodes[triangles[:, 0]]).sum(axis=1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return nodes, triangles


@pytest.mark.parametrize("size", [2, 3])
def test_barycentric_map_agrees_with_scipy_and_is_exact_for_linear_fields(size):
    delaunay = pytest.importorskip("scipy.spatial").Delaunay
    rng = np.random.default_rng(0)
    nodes, points = rng.random((60, size)), rng.random((300, size)) * 1.4 - 0.2
    mesh = delaunay(nodes)
    found = barycentric_map(points, nodes, mesh.simplices)
    cell = mesh.find_simplex(points)
    assert_array_equal(found.inside, cell >= 0)
    inside, cell = found.inside, cell[found.inside]
    shift = points[inside] - mesh.transform[cell, size]
    others = np.einsum("nij,nj->ni", mesh.transform[cell, :size], shift)
    values = rng.random((60, 2))
    weights = np.concatenate([others, 1 - others.sum(1, keepdims=True)], 1)
    wanted = (weights[..., None] * values[mesh.simplices[cell]]).sum(1)
    assert_allclose(found(values)[inside], wanted, atol=1e-9)
    slope = rng.random(size)
    assert_allclose(found(nodes @ slope + 2), points @ slope + 2, atol=1e-9)  # outside, too


def test_trilinear_map_agrees_with_scipy():
    interpolate = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(0)
    shape, origin, spacing = (4, 2, 5), np.array([1.0, -2.0, 0.5]), np.array([0.5, 2.0, 0.1])
    axes = [o + d * np.arange(n) for o, d, n in zip(origin, spacing, shape, strict=True)]
    high = origin + spacing * (np.array(shape) - 1)
    points = rng.uniform(origin - 0.3, high + 0.3, (200, 3))
    values = rng.random(shape)
    found = trilinear_map(points, origin, spacing, shape)
    assert_array_equal(found.inside, ((points >= origin) & (points <= high)).all(1))
    wanted = interpolate.RegularGridInterpolator(axes, values)(np.clip(points, origin, high))
    assert_allclose(found(values.ravel()), wanted)
    flat = trilinear_map([[3.0], [9.0]], [0.0], 1.0, (1,))  # a single point along an axis
    assert_allclose(flat([7.0]), 7.0)


def test_voxels_of_a_cube_and_its_margin():
    grid = voxelize(CORNERS, SIDES, 0.25, margin=2)
    wanted = np.zeros((8, 8, 8), bool)
    wanted[2:-2, 2:-2, 2:-2] = True
    assert_array_equal(grid.inside, wanted)
    assert_allclose([grid.centers.min(), grid.centers.max()], [0.125, 0.875])
    assert_array_equal(grid.cube_at[tuple(grid.cubes.T)], np.arange(64))
    assert (grid.cube_at == -1).sum() == 8**3 - 64
    height = np.indices(grid.inside.shape)[2] * grid.spacing + grid.origin[2]
    assert_allclose(grid.map_to(CORNERS)(height.ravel()), CORNERS[:, 2])


@pytest.mark.slow
def test_voxels_of_a_ball_have_its_volume():
    nodes, triangles = ball()
    grid = voxelize(nodes, triangles, 0.1, margin=1)
    corners = nodes[triangles]
    volume = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert_allclose(grid.inside.sum() * grid.spacing**3, volume, rtol=0.02)
    assert_array_equal(grid.inside, voxelize(nodes, triangles[:, ::-1], 0.1, margin=1).inside)


def test_visible_nodes_of_a_ball_are_those_whose_triangles_face_the_eye():
    nodes, triangles = ball()
    eye = np.array([3.0, 1.0, -2.0])
    corners = nodes[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces = ((eye - corners[:, 0]) * normals).sum(1) > 0  # of a convex body
    seen = np.zeros(len(nodes), bool)
    seen[triangles[faces]] = True
    assert_array_equal(visible(nodes, eye, nodes, triangles), seen)


def test_a_triangle_hides_what_is_behind_it_alone():
    wall = np.array([[0, -1, -1], [0, 1, -1], [0, 0, 1]], float)
    points = [[1, 0, 0], [-1, 0, 0], [1, 3, 0], [0, 0, 0], [3, 0, 0]]
    found = visible(points, [-2, 0, 0], wall, [[0, 1, 2]])
    assert found.tolist() == [False, True, True, True, False]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: barycentric_map([[0, 0]], [[0, 0, 0]], [[0, 0, 0, 0]]), r"points have the shape"),
        (lambda: barycentric_map([[0, 0]], CORNERS[:, :2], [[0, 1, 0]]), "cell 0 has no volume"),
        (lambda: trilinear_map([[0.0]], [0.0], -1.0, (3,)), "has no points"),
        (lambda: voxelize(CORNERS, SIDES, 0.0), "are no grid"),
    ],
)
def test_wrong_geometry_is_an_error(call, words):
    with pytest.raises(ConfigError, match=words):
        call()
