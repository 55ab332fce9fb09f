"""The fields of a dataset, and rows that do not fit them."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset, Field
from physx_core.errors import (
    ConfigError,
    FieldShapeError,
    FieldsMismatchError,
    FieldTypeError,
    MissingFieldError,
    NotFiniteError,
    UnknownFieldError,
)

# Fields ---------------------------------------------------------------------------------------

FIELDS = [
    Field("q", unit="rad"),
    Field("tau", (7,), "float32", unit="N m"),
    Field("seen", (), "bool", role="additional"),
]


def test_units_and_roles_are_kept(dataset, folder):
    dataset.define_fields("training", FIELDS)
    assert dataset.modes == ["training"] and dataset.num_samples("training") == 0
    dataset.append(
        "training", {"tau": np.ones((2, 7)), "q": np.zeros((2, 3)), "seen": [True, False]}
    )
    dataset.close()
    with Dataset.open(folder) as again:
        fields = again.fields("training")
        assert list(fields) == ["q", "tau", "seen"]
        assert fields["q"] == Field("q", (3,), unit="rad")
        assert fields["tau"] == FIELDS[1] and fields["seen"] == FIELDS[2]
        assert again.describe()[1] == {
            "mode": "training", "field": "tau", "role": "training", "dtype": "float32",
            "shape": (7,), "unit": "N m", "axes": (), "like": "", "samples": 2,
            "partitions": 1, "bytes": 56,
        }  # fmt: skip


def test_a_defined_mode_without_rows_is_kept(dataset, folder):
    dataset.define_fields("validation", FIELDS)
    dataset.close()
    with Dataset.open(folder) as again:
        assert again.fields("validation")["q"] == FIELDS[0]
        assert again["validation"]["q"][:].shape == (0,)
        assert again.normalization_of("validation") == {}


def test_defining_again_completes_or_does_nothing(dataset):
    dataset.define_fields("training", FIELDS)
    dataset.define_fields("training", [Field("q", (3,), unit="rad"), *FIELDS[1:]])
    assert dataset.fields("training")["q"].shape == (3,)
    dataset.define_fields("training", FIELDS)
    assert dataset.fields("training")["q"].shape == (3,)


def test_each_different_field_is_reported(dataset):
    dataset.append("training", {"x": np.zeros((1, 3)), "y": np.zeros(1), "z": np.zeros(1)})
    other = [Field("x", (4,), unit="m"), Field("y", (), "int32", role="additional"), Field("w")]
    with pytest.raises(FieldsMismatchError) as caught:
        dataset.define_fields("training", other)
    assert set(caught.value.differences) == {"x", "y", "z", "w"}
    assert "shape (3,), not (4,)" in caught.value.differences["x"]
    assert "unit '', not 'm'" in caught.value.differences["x"]
    assert "type float64, not int32" in caught.value.differences["y"]


def test_reserved_fields_are_additional(dataset):
    dataset.append("training", {"x": np.zeros(2), "env_id": [1, 2], "step": [0, 0]})
    roles = {name: field.role for name, field in dataset.fields("training").items()}
    assert roles == {"x": "training", "env_id": "additional", "step": "additional"}


@pytest.mark.parametrize("name", ["two words", "", "a/b"])
def test_a_modes_name_is_an_identifier(dataset, name):
    with pytest.raises(ConfigError):
        dataset.append(name, {"x": np.zeros(1)})
    with pytest.raises(ConfigError):
        dataset.define_fields("training", [])


# What cannot be stored ------------------------------------------------------------------------

GOOD = {"x": np.ones((2, 3)), "n": np.array([1, 2], "int32")}
BAD = {
    "missing": (MissingFieldError, {"x": np.ones((2, 3))}),
    "unknown": (UnknownFieldError, {**GOOD, "xx": np.ones(2)}),
    "shape": (FieldShapeError, {**GOOD, "x": np.ones((2, 4))}),
    "rank": (FieldShapeError, {**GOOD, "x": np.ones(2)}),
    "no axis": (FieldShapeError, {**GOOD, "n": np.int32(1)}),
    "ragged": (FieldShapeError, {**GOOD, "x": [[1, 2, 3], [1]]}),
    "length": (FieldShapeError, {**GOOD, "n": np.array([1], "int32")}),
    "kind": (FieldTypeError, {**GOOD, "n": np.array([1.5, 2.0])}),
    "too large": (FieldTypeError, {**GOOD, "n": np.array([1, 2**40])}),
    "text": (FieldTypeError, {**GOOD, "n": np.array(["a", "b"])}),
    "object": (FieldTypeError, {**GOOD, "n": np.array([None, {}])}),
    "nan": (NotFiniteError, {**GOOD, "x": np.array([[1, 1, 1], [1, np.nan, 1]])}),
    "inf": (NotFiniteError, {**GOOD, "x": np.array([[1, -np.inf, 1], [1, 1, 1]])}),
    "both": (NotFiniteError, {**GOOD, "x": np.array([[np.inf, -np.inf, 1], [1, 1, 1]])}),
    "many": (NotFiniteError, {"x": np.full((9000, 3), np.nan), "n": np.zeros(9000, "int32")}),
}


@pytest.mark.parametrize("case", BAD)
def test_wrong_rows_leave_the_dataset_as_it_is(dataset, folder, case):
    kind, bad = BAD[case]
    dataset.append("training", GOOD)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(kind) as caught:
        dataset.append("training", bad)
    assert caught.value.field in {"x", "n", "xx", ""}
    assert before == {path.name: path.read_bytes() for path in folder.iterdir()}
    dataset.append("training", GOOD)
    assert dataset.num_samples("training") == 4
    for name, values in GOOD.items():
        stored = dataset["training"][name][:]
        assert stored.dtype == values.dtype
        assert_array_equal(stored, np.concatenate([values, values]))


@pytest.mark.parametrize("case", sorted(set(BAD) - {"length", "many", "no axis", "rank"}))
def test_wrong_samples_leave_the_buffer_as_it_is(dataset, case):
    kind, bad = BAD[case]
    good = {"x": np.ones(3), "n": 1}
    row = 1 if case in ("nan", "too large") else 0
    dataset.define_fields("training", [Field("x", (3,)), Field("n", (), "int32")])
    dataset.append_sample("training", good)
    sample = {name: values[row] for name, values in bad.items()}
    if case == "ragged":
        sample["x"] = [[1, 2], [3]]
    with pytest.raises(kind):
        dataset.append_sample("training", sample)
    dataset.append_sample("training", good)
    assert_array_equal(dataset["training"]["x"][:], np.ones((2, 3)))


def test_a_wrong_first_block_defines_nothing(dataset):
    for bad in ({"x": np.array([np.nan])}, {"x": 1.0}, {"x": np.array(["a"])}):
        with pytest.raises((NotFiniteError, FieldShapeError, FieldTypeError)):
            dataset.append("training", bad)
    assert dataset.modes == []


def test_large_finite_values_are_fine(dataset):
    values = np.full((3, 2), 1e300)
    dataset.append("training", {"x": values, "y": np.full(3, 3e38, "float32")})
    dataset.append_sample("training", {"x": values[0], "y": 3e38})
    assert dataset.num_samples("training") == 4
    with pytest.raises(NotFiniteError):
        dataset.append("training", {"x": values, "y": np.full(3, 1e300)})


def test_checked_rows_are_still_of_the_fields_names_shapes_and_types(dataset):
    dataset.define_fields("training", [Field("x", (), "float32")])
    dataset.append("training", {"x": np.ones(2, "float32")}, checked=True)
    for error, rows in (
        (UnknownFieldError, {"x": np.ones(1, "float32"), "y": [1]}),
        (FieldShapeError, {"x": np.ones((1, 2), "float32")}),
        (FieldTypeError, {"x": [1j]}),
        (NotFiniteError, {"x": [1e300]}),
    ):
        with pytest.raises(error):
            dataset.append("training", rows, checked=True)
    assert dataset.num_samples("training") == 2
