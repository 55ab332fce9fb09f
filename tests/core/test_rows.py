import numpy as np
import pytest

from physx_core import Field
from physx_core.errors import (
    FieldShapeError,
    FieldTypeError,
    MissingFieldError,
    NotFiniteError,
    UnknownFieldError,
)
from physx_core.rows import RowBuffer, infer_shapes

FIELDS = [Field("x", (2,)), Field("n", (), "int32")]


def test_rows_are_copies_with_instance_and_step():
    columns = RowBuffer(FIELDS, 4)
    x = np.array([1.0, 2.0])
    columns.put(0, {"x": x, "n": 3}, 2, 5, 7)
    x[:] = 0
    rows, names = columns.rows(1), ("n", "env_id", "episode", "step")
    assert rows["x"].tolist() == [[1, 2]]
    assert [rows[name].tolist() for name in names] == [[3], [2], [5], [7]]


@pytest.mark.parametrize(
    ("sample", "error", "field"),
    [
        ({"x": np.zeros(2)}, MissingFieldError, "n"),
        ({"x": np.zeros(2), "n": 1, "m": 1}, UnknownFieldError, "m"),
        ({"x": np.zeros(3), "n": 1}, FieldShapeError, "x"),
        ({"x": np.zeros((1, 2)), "n": 1}, FieldShapeError, "x"),
        ({"x": 1.0, "n": 1}, FieldShapeError, "x"),
        ({"x": [[1], [1, 2]], "n": 1}, FieldShapeError, "x"),
        ({"x": np.zeros(2), "n": 1.5}, FieldTypeError, "n"),
        ({"x": np.zeros(2), "n": "a"}, FieldTypeError, "n"),
        ({"x": np.zeros(2, complex), "n": 1}, FieldTypeError, "x"),
        ({"x": np.array([None, 1]), "n": 1}, FieldTypeError, "x"),
    ],
)
def test_what_does_not_fit_is_named(sample, error, field):
    with pytest.raises(error, match=f'Instance 3, step 5: field "{field}"') as caught:
        RowBuffer(FIELDS, 1).put(0, sample, 3, 0, 5)
    assert (caught.value.field, caught.value.instance_id, caught.value.step) == (field, 3, 5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_the_first_row_that_is_not_finite_is_named(bad):
    columns = RowBuffer(FIELDS, 3)
    for row in range(3):
        columns.put(row, {"x": np.array([0, bad if row else 1.0]), "n": 0}, row + 1, 0, 10 + row)
    assert len(columns.rows(1)["x"]) == 1
    with pytest.raises(NotFiniteError, match='Instance 2, step 11: field "x"'):
        columns.rows(3)


def test_open_shapes_are_taken_from_the_first_sample():
    fields = infer_shapes([Field("x"), Field("y", (1,))], {"x": [[1, 2]], "y": 0})
    assert [field.shape for field in fields] == [(1, 2), (1,)]
