import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physx_core import Field
from physx_core.errors import (
    FieldShapeError,
    FieldTypeError,
    MissingFieldError,
    NotFiniteError,
    SampleError,
    UnknownFieldError,
)
from physx_core.rows import RowBuffer, infer_shapes

FIELDS = [Field("x", (2,)), Field("n", (), "int32")]


def test_rows_are_copies_with_instance_and_step():
    buffer = RowBuffer(FIELDS, 4)
    x = np.array([1.0, 2.0])
    buffer.put({"x": x, "n": 3}, 2, 5, 7)
    x[:] = 0
    rows, names = buffer.take(), ("n", "env_id", "episode", "step")
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
        RowBuffer(FIELDS, 1).put(sample, 3, 0, 5)
    assert (caught.value.field, caught.value.instance_id, caught.value.step) == (field, 3, 5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_the_first_row_that_is_not_finite_is_named(bad):
    buffer = RowBuffer(FIELDS, 3)
    for row in range(3):
        buffer.put({"x": np.array([0, bad if row else 1.0]), "n": 0}, row + 1, 0, 10 + row)
    with pytest.raises(NotFiniteError, match='Instance 2, step 11: field "x"'):
        buffer.take()
    assert buffer.take()["env_id"].tolist() == [1]
    assert buffer.count == 0


def test_the_first_row_is_named_whatever_its_field():
    buffer = RowBuffer([Field("a", ()), Field("b", ())], 3)
    for row, (a, b) in enumerate([(0, 0), (0, np.nan), (np.nan, np.nan)]):
        buffer.put({"a": a, "b": b}, 1, 0, row)
    with pytest.raises(NotFiniteError, match='step 1: field "b"'):
        buffer.take()
    assert buffer.take()["step"].tolist() == [0]


def test_a_row_that_is_checked_at_once_leaves_the_buffer_as_it_was():
    buffer = RowBuffer(FIELDS, 3, numbered=False)
    buffer.put({"x": [1, 2], "n": 1}, finite=True)
    for x in ([np.nan, 0], [0, np.inf], [0, 0, 0]):
        with pytest.raises(SampleError):
            buffer.put({"x": x, "n": 2}, finite=True)
    buffer.put({"x": [3, 4], "n": 3}, finite=True)
    assert {name: rows.tolist() for name, rows in buffer.take().items()} == {
        "x": [[1, 2], [3, 4]],
        "n": [1, 3],
    }


def test_fields_that_are_one_array_are_warned_of():
    state = np.zeros(2)
    buffer = RowBuffer([Field("before", (2,)), Field("after", (2,))])
    with pytest.warns(UserWarning, match=r'"before" and "after" are the same array.*copy\(\)'):
        buffer.put({"before": state[:], "after": state})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        buffer.take()
        buffer.put({"before": state.copy(), "after": state})
        buffer.take()
        buffer.put({"before": np.zeros((4, 2))[:2].T[0], "after": np.zeros(2)})


def test_a_buffer_holds_one_mebibyte_at_most():
    for width, capacity in ((1, 4096), (64, 2048), (2**18, 1)):
        assert RowBuffer([Field("x", (width,))], numbered=False).capacity == capacity


def test_open_shapes_are_taken_from_the_first_sample():
    fields = infer_shapes([Field("x"), Field("y", (1,))], {"x": [[1, 2]], "y": 0})
    assert [field.shape for field in fields] == [(1, 2), (1,)]


@given(
    st.integers(1, 6),
    st.booleans(),
    st.lists(st.sampled_from(["put", "checked", "wrong", "nan", "take", "clear"]), max_size=40),
)
def test_a_buffer_is_what_a_list_is(capacity, numbered, calls):
    buffer, rows = RowBuffer(FIELDS, capacity, numbered=numbered), []
    for number, call in enumerate(calls):
        assert buffer.count == len(rows) and buffer.full == (len(rows) == capacity)
        sample, place = {"x": [number, 0.5], "n": number}, (1 + number % 3, number // 5, number)
        if call == "clear":
            buffer.clear()
            rows = []
        elif call == "take":
            bad = next((k for k, row in enumerate(rows) if np.isnan(row[0][1])), None)
            if bad is not None:
                with pytest.raises(NotFiniteError) as caught:
                    buffer.take()
                assert caught.value.step == (rows[bad][4] if numbered else -1)
                rows = rows[:bad]
            names = ["x", "n", "env_id", "episode", "step"][: 5 if numbered else 2]
            found = {name: block.tolist() for name, block in buffer.take().items()}
            assert found == {name: [row[k] for row in rows] for k, name in enumerate(names)}
            rows = []
        elif call == "wrong" and not buffer.full:
            with pytest.raises(SampleError):
                buffer.put({**sample, "n": 0.5}, *place)
            with pytest.raises(SampleError):
                buffer.put({**sample, "x": [number, np.inf]}, *place, finite=True)
        elif not buffer.full:
            if call == "nan":
                sample["x"][1] = np.nan
            buffer.put(sample, *place, finite=call == "checked")
            rows.append((sample["x"], number, *place))
