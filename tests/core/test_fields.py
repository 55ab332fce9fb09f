import numpy as np
import pytest

from physx_core import Field
from physx_core.errors import ConfigError
from physx_core.fields import as_fields


def test_field_brings_shape_and_type_to_their_plain_form():
    field = Field("force", 3, np.float32, unit="N")
    assert (field.shape, field.dtype, field.nbytes) == ((3,), "<f4", 12)


@pytest.mark.parametrize("dtype", [bool, "int8", "uint64", ">f4", "float16", "complex128"])
def test_plain_types_survive_the_trip_through_plain_data(dtype):
    field = Field("x", (2, 3), dtype, unit="m", role="additional")
    assert Field.from_dict(field.to_dict()) == field
    assert np.dtype(field.dtype).byteorder in "=|<"


@pytest.mark.parametrize("name", ["", "a b", "1x", "a/b", 3])
def test_names_that_are_not_identifiers_are_rejected(name):
    with pytest.raises(ConfigError, match="identifier"):
        Field(name)


@pytest.mark.parametrize("dtype", [object, str, "U5", "datetime64[s]", "nonsense"])
def test_types_without_a_fixed_plain_layout_are_rejected(dtype):
    with pytest.raises(ConfigError):
        Field("x", (1,), dtype)


@pytest.mark.parametrize("shape", [(-1,), (1.5,), (2, "a")])
def test_malformed_shapes_are_rejected(shape):
    with pytest.raises(ConfigError, match="shape"):
        Field("x", shape)


def test_as_fields_takes_all_forms_and_sets_the_role():
    fields = as_fields([("a", np.ndarray), ("b", float), "c", Field("d", (2,))], "additional")
    assert [f.shape for f in fields] == [None, (), None, (2,)]
    assert {f.role for f in fields} == {"additional"}
    assert as_fields(("a", np.ndarray), "training") == [Field("a")]


def test_reserved_and_malformed_fields_are_rejected():
    with pytest.raises(ConfigError, match="reserved"):
        as_fields("env_id", "training")
    with pytest.raises(ConfigError, match="not a field"):
        as_fields([42], "training")
