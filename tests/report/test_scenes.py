"""Scenes: what of a drawing follows from a field, and what predictions change of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physx_core.components import Factory
from physx_report.scenes import Scene, begin_prediction, end_prediction, find_links


def drawn(draw, rows):
    """Return the scene, and the numbers drawn at each row of a field."""
    factory, scene, found = Factory(), Scene(), []
    for number, row in enumerate(rows):
        draw(factory, row, number == 0)
        scene.take(factory.take_events())
        found.append(scene.numbers())
    return scene, found


def mesh(factory, row, is_first):
    if is_first:
        factory.add_mesh("cloth", positions=np.zeros((4, 3)), cells=[[0, 1, 2]])
    factory.update_mesh("cloth", positions=REST + row)


def membrane(factory, row, is_first):
    if is_first:
        factory.add_mesh("skin", positions=REST, cells=[[0, 1, 2]], scalar_field=np.zeros(4))
    height = np.column_stack([REST[:, :2], -0.5 * row])
    factory.update_mesh("skin", positions=height, scalar_field=row)


def spring(factory, row, is_first):
    if is_first:
        factory.add_sphere("mass", radius=0.1)
        factory.add_lines("spring", [[0, 0, 0], [1, 0, 0]])
    factory.update_sphere("mass", position=[2 * row[1], 0, 1])
    factory.update_lines("spring", positions=[[0, 0, 0], [2 * row[1], 0, 0]])


def slices(factory, row, is_first):
    if is_first:
        factory.add_slice("flow", values=np.zeros((2, 3)), spacing=(1, 1))
    factory.update_slice("flow", values=row[1])


REST = np.random.default_rng(0).normal(size=(4, 3))
DRAWINGS = {
    mesh: ((4, 3), {("cloth", "positions")}),
    membrane: ((4,), {("skin", "positions"), ("skin", "scalar_field")}),
    spring: ((2,), {("mass", "position"), ("spring", "positions")}),
    slices: ((2, 2, 3), {("flow", "values")}),
}


@pytest.mark.parametrize("draw", DRAWINGS)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(5, 12))
def test_predictions_are_drawn_as_the_environment_would_draw_them(draw, seed, count):
    shape, expected = DRAWINGS[draw]
    rows, other = np.random.default_rng(seed).normal(size=(2, count, *shape))
    scene, frames = drawn(draw, rows)
    links = find_links(frames, {"u": rows})
    assert {(each.name, each.option) for each in links} == expected
    shown = Scene()
    shown.objects = {name: (kind, dict(given)) for name, (kind, given) in scene.objects.items()}
    shown.take(begin_prediction(scene, links, {"u": rows[-1]}, {"u": other[-1]}))
    _, wanted = drawn(draw, [rows[0], other[-1]])
    for key in expected:
        np.testing.assert_allclose(shown.numbers()[key], wanted[-1][key], atol=2e-5)
    shown.take(end_prediction(scene, links))
    assert shown.objects.keys() == scene.objects.keys()
    for key in expected:
        np.testing.assert_array_equal(shown.numbers()[key], frames[-1][key])


@pytest.mark.parametrize("change", [np.sin, np.square, np.abs])
def test_what_is_no_factor_times_a_field_does_not_follow_from_it(change):
    rows = np.random.default_rng(0).normal(size=(12, 4, 3))
    _, frames = drawn(mesh, change(rows))
    assert not find_links(frames, {"u": rows})


def test_too_few_rows_say_nothing():
    rows = np.random.default_rng(0).normal(size=(1, 4, 3))
    _, frames = drawn(mesh, rows)
    assert not find_links(frames, {"u": rows}) and not find_links([], {})
